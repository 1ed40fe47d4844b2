"""Protocol of the true trajectory of the IMU."""

from __future__ import annotations

from typing import Protocol

import numpy as np


class TrueTrajectory(Protocol):
    """True poses and readings of the IMU at any instant."""

    def pose_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R_world_imu (N, 3, 3), position (N, 3) m and velocity (N, 3) m/s in the world, at seconds (N,) since the IMU
        clock's origin."""
        ...

    def rate_at(self, seconds: np.ndarray) -> np.ndarray:
        """Angular rate (N, 3) [rad/s] in the IMU frame at seconds (N,) since the IMU clock's origin."""
        ...

    def readings_at(self, seconds: np.ndarray) -> np.ndarray:
        """(N, 6) true angular rate [rad/s] and specific force [m/s^2] in the IMU frame at seconds (N,)."""
        ...
