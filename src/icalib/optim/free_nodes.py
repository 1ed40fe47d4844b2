"""In place of an IMU: nodes that nothing ties to each other. Each is an instant at which images were taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from icalib.optim.arrowhead import Piece
from icalib.optim.state import NODE, State

POSE = 6
WEAK = (
    1e-9  # information [1/rad^2, 1/m^2]: keeps a keyframe defined whose corners were all rejected; steers nothing else
)


@dataclass(frozen=True)
class FreeNodes:
    """Velocity and biases, which nothing sees, are held where they are."""

    kinds: ClassVar[dict[str, slice]] = {}

    name: str  # of the body's sensor
    n_nodes: int

    @property
    def starts(self) -> tuple[int, ...]:
        """One chain: where nothing ties neighbours, recordings make no difference."""
        return (0,)

    def accumulate(self, state: State, piece: Piece, out: np.ndarray, sums: bool = True) -> float:
        """Defines what corners leave open in the nodes of `piece`. Returns half a chi^2 of nothing."""
        del state, out
        if sums:
            own = np.concatenate([np.full(POSE, WEAK), np.ones(NODE - POSE)])
            piece.diagonal[:, range(NODE), range(NODE)] += own
        return 0.0

    def accumulate_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Nothing: there are no biases."""
        del state, piece, sums
        return 0.0
