"""In place of an IMU: keyframes that nothing ties to each other. Each is an instant at which images were taken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.motion.factor import FactorKey, RowFactor, Whitened
from icalib.motion.imu_data import ImuData
from icalib.optim.arrowhead import Piece
from icalib.optim.state import KEYFRAME_DIM, POSE_DIM, State

# information [1/rad^2, 1/m^2]: keeps a keyframe defined whose corners were all rejected; steers nothing else
WEAK_POSE_INFORMATION = 1e-9


@dataclass(frozen=True)
class IndependentKeyframes(RowFactor):
    """Velocity and biases, which nothing sees, are held where they are."""

    name: str  # of the body's sensor
    n_keyframes: int

    @property
    def key(self) -> FactorKey:
        return self.name, "keyframes"

    @property
    def kinds(self) -> dict[str, slice]:
        """None: no measurement."""
        return {}

    @property
    def starts(self) -> tuple[int, ...]:
        """One chain: where nothing ties neighbours, recordings make no difference."""
        return (0,)

    def with_imu(self, imu: ImuData) -> IndependentKeyframes:
        """The same: there is none."""
        del imu
        return self

    def output(self) -> Whitened:
        """Rows (K - 1, 15) that stay empty."""
        return Whitened.without_loss(self.n_keyframes - 1, KEYFRAME_DIM)

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """Defines what corners leave open in the keyframes of `piece`. Returns half a chi^2 of nothing."""
        del state, out, curved
        if sums:
            own = np.concatenate([np.full(POSE_DIM, WEAK_POSE_INFORMATION), np.ones(KEYFRAME_DIM - POSE_DIM)])
            piece.diagonal[:, range(KEYFRAME_DIM), range(KEYFRAME_DIM)] += own
        return 0.0

    def accumulate_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Nothing: there are no biases."""
        del state, piece, sums
        return 0.0
