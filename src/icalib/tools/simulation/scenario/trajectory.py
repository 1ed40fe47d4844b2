"""What is asked of the true trajectory of the IMU."""

from __future__ import annotations

from typing import Protocol

import numpy as np


class TrueTrajectory(Protocol):
    """The pose of the IMU at any instant."""

    def pose_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """seconds (N,) since the IMU clock's origin -> R_world_imu (N, 3, 3), position, velocity (N, 3) in world."""
        ...

    def rate_at(self, seconds: np.ndarray) -> np.ndarray:
        """seconds (N,) -> angular rate (N, 3) [rad/s] in the imu frame."""
        ...


class AnalyticTrajectory(TrueTrajectory, Protocol):
    """A trajectory that an IMU can sample."""

    def readings_at(self, seconds: np.ndarray) -> np.ndarray:
        """(N, 6) true angular rate [rad/s] and specific force [m/s^2] in the imu frame."""
        ...
