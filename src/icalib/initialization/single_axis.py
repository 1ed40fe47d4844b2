"""All turns about one axis: rates leave the camera's rotation about it open, accelerations may still tell."""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3
from icalib.initialization.dead_reckoning import DeadReckoning
from icalib.initialization.gravity import camera_triples, fit_gravity
from icalib.initialization.guess import BoardPoses
from icalib.initialization.rotation import RateFit

_COARSE = np.deg2rad(15.0)
_ZOOMS = 4  # each narrows the step to a quarter


def turn_about_axis(
    seconds: np.ndarray,
    poses: BoardPoses,
    fit: RateFit,
    lever: np.ndarray | None,
    reckoning: DeadReckoning,
    name: str,
) -> np.ndarray:
    """R_imu_cam (3, 3), turned about `fit.axis` to where the accelerations fit best: a scan, then zooms into it."""
    assert fit.axis is not None

    def turned(angle: float) -> np.ndarray:
        return so3.exp(angle * fit.axis) @ fit.R_imu_cam

    def cost(angle: float) -> float:
        return fit_gravity([camera_triples(seconds, poses, turned(angle), lever, reckoning, name)]).cost

    angles, step = np.arange(-np.pi, np.pi, _COARSE), _COARSE
    best = min(angles, key=cost)
    for _ in range(_ZOOMS):
        step /= 4.0
        best = min(best + step * np.arange(-3, 4), key=cost)
    return turned(best)
