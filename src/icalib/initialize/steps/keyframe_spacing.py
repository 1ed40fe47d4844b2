"""How far apart keyframes may be where smooth motion is assumed in place of an IMU.

Between keyframes the motion is propagated with constant rate and acceleration. White angular acceleration of density
`turning` [rad/s^2/sqrt(Hz)] adds a rotation of turning sqrt(t^3 / 3) in t seconds, white jerk of density `jerking`
[m/s^3/sqrt(Hz)] a displacement of jerking sqrt(t^5 / 20) (integrated Wiener processes). Both must stay small against
the noise of the measurements: of poses, half a spacing away from their keyframe, and of increments over a whole
spacing h, whose noise grows with sqrt(h).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

from icalib.initialize.steps.smooth_trajectory import SmoothTrajectory

MAX_PROPAGATION_SHARE = 0.25  # of the noise; it adds 6 % to the variance


@dataclass(frozen=True)
class SmoothMotion:
    """The assumption: densities `turning` [rad/s^2/sqrt(Hz)] and `jerking` [m/s^3/sqrt(Hz)] of the body, which moved
    along `paths`, one for each recording."""

    paths: Sequence[SmoothTrajectory]
    turning: float
    jerking: float

    def spacing_for_poses(self, turn: float, way: float) -> float:
        """The largest spacing [s] for poses with noise `turn` [rad] and `way` [m]."""
        return min(
            2.0 * (3.0 * (MAX_PROPAGATION_SHARE * turn / self.turning) ** 2) ** (1 / 3),
            2.0 * (20.0 * (MAX_PROPAGATION_SHARE * way / self.jerking) ** 2) ** 0.2,
        )

    def spacing_for_increments(self, turn: float, way: float) -> float:
        """The largest spacing [s] for increments with noise `turn` [rad/sqrt(s)] and `way` [m/sqrt(s)]."""
        return min(
            sqrt(3.0) * MAX_PROPAGATION_SHARE * turn / self.turning,
            (20.0 * (MAX_PROPAGATION_SHARE * way / self.jerking) ** 2) ** 0.25,
        )
