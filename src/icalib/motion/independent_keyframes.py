"""Replacement of the IMU factor in a rig without IMU: keyframes at image instants, with no term between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.motion.factor import FactorKey, RowFactor, Whitened
from icalib.motion.imu_data import ImuData
from icalib.optim.arrowhead import Piece
from icalib.optim.state import KEYFRAME_DIM, POSE_DIM, State

# information [1/rad^2, 1/m^2]: keeps a keyframe without measurements positive definite; too weak for other effects
WEAK_POSE_INFORMATION = 1e-9


@dataclass(frozen=True)
class IndependentKeyframes(RowFactor):
    """Chain factor without measurements: a little information keeps each keyframe positive definite. Velocity and
    biases, on which no measurement depends, are fixed."""

    name: str  # of the sensor that is the body frame
    n_keyframes: int

    @property
    def key(self) -> FactorKey:
        return self.name, "keyframes"

    @property
    def kinds(self) -> dict[str, slice]:
        """Empty: the factor has no residuals."""
        return {}

    @property
    def starts(self) -> tuple[int, ...]:
        """(0,): one chain for all recordings, because no term links neighbours."""
        return (0,)

    @property
    def imu(self) -> None:
        """None: no readings link keyframes."""
        return None

    def with_imu(self, imu: ImuData, state: State) -> IndependentKeyframes:
        """The same factor, as there is no IMU."""
        del imu, state
        return self

    def output(self) -> Whitened:
        """Empty rows (K - 1, 15)."""
        return Whitened.without_loss(self.n_keyframes - 1, KEYFRAME_DIM)

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """Adds information that keeps the keyframes of `piece` positive definite. Returns 0, its cost."""
        del state, out, curved
        if sums:
            information = np.concatenate([np.full(POSE_DIM, WEAK_POSE_INFORMATION), np.ones(KEYFRAME_DIM - POSE_DIM)])
            piece.diagonal[:, range(KEYFRAME_DIM), range(KEYFRAME_DIM)] += information
        return 0.0

    def accumulate_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Returns 0, as there are no biases."""
        del state, piece, sums
        return 0.0
