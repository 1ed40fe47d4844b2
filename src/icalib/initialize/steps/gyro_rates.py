"""How fast an IMU turned on average over the intervals between images or poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.initialize.steps.rate_correlation import interpolated
from icalib.motion.imu_data import ImuData


@dataclass(frozen=True)
class MeanRates:
    """Mean rates of the gyroscope over intervals, start to end (n,) on its clock [s]; angle (N, 3) rad: the integral of
    its readings from the first to each."""

    imu: ImuData
    angle: np.ndarray

    @classmethod
    def of(cls, imu: ImuData) -> MeanRates:
        angle = np.zeros((len(imu.seconds), 3))
        angle[1:] = np.cumsum(0.5 * (imu.gyro[1:] + imu.gyro[:-1]) * np.diff(imu.seconds)[:, None], axis=0)
        return cls(imu, angle)

    def over(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """(n, 3) rad/s."""
        t = self.imu.seconds
        return (interpolated(t, self.angle, end) - interpolated(t, self.angle, start)) / (end - start)[:, None]

    def slope(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """(n, 3) rad/s^2: how they change where both ends are later."""
        t, gyro = self.imu.seconds, self.imu.gyro
        return (interpolated(t, gyro, end) - interpolated(t, gyro, start)) / (end - start)[:, None]
