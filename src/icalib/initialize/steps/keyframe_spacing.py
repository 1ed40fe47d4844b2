"""Largest spacing of keyframes if smooth motion is assumed in place of an IMU.

Between keyframes the motion is propagated with constant angular rate and acceleration. White angular acceleration of
density `turning` [rad/s^2/sqrt(Hz)] adds a rotation of turning sqrt(t^3 / 3) in t seconds. White jerk of density
`jerking` [m/s^3/sqrt(Hz)] adds a displacement of jerking sqrt(t^5 / 20) (integrated Wiener processes). Both must stay
below MAX_PROPAGATION_SHARE of the measurement noise. Poses are at most half a spacing from their keyframe. Increments
span a whole spacing h, and their noise grows with sqrt(h).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

from icalib.initialize.steps.smooth_trajectory import SmoothTrajectory

MAX_PROPAGATION_SHARE = 0.25  # propagation error over measurement noise: it adds 6 % to the variance


@dataclass(frozen=True)
class SmoothMotion:
    """The assumed motion: densities `turning` [rad/s^2/sqrt(Hz)] and `jerking` [m/s^3/sqrt(Hz)] of the body, and its
    trajectory in each recording."""

    paths: Sequence[SmoothTrajectory]
    turning: float
    jerking: float

    def spacing_for_poses(self, rotation_noise: float, position_noise: float) -> float:
        """The largest spacing [s] for poses with noise of these standard deviations [rad, m]."""
        return min(
            2.0 * (3.0 * (MAX_PROPAGATION_SHARE * rotation_noise / self.turning) ** 2) ** (1 / 3),
            2.0 * (20.0 * (MAX_PROPAGATION_SHARE * position_noise / self.jerking) ** 2) ** 0.2,
        )

    def spacing_for_increments(self, rotation_noise: float, position_noise: float) -> float:
        """The largest spacing [s] for increments with noise of these densities [rad/sqrt(s), m/sqrt(s)]."""
        return min(
            sqrt(3.0) * MAX_PROPAGATION_SHARE * rotation_noise / self.turning,
            (20.0 * (MAX_PROPAGATION_SHARE * position_noise / self.jerking) ** 2) ** 0.25,
        )
