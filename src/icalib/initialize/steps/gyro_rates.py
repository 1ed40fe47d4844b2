"""Mean angular rate of an IMU over the intervals between images or poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry.integrals import once_integrated
from icalib.initialize.steps.rate_correlation import interpolated
from icalib.motion.imu_data import ImuData


@dataclass(frozen=True)
class MeanRates:
    """Means of the gyroscope's readings. angle (N, 3) rad: their integral from the first stamp to each."""

    imu: ImuData
    angle: np.ndarray

    @classmethod
    def of(cls, imu: ImuData) -> MeanRates:
        """Integrates the readings of `imu` by the trapezoidal rule."""
        return cls(imu, once_integrated(imu.gyro, np.diff(imu.seconds)))

    def over(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Mean rates (n, 3) rad/s over intervals from start to end (n,), in s on the IMU's clock."""
        t = self.imu.seconds
        return (interpolated(t, self.angle, end) - interpolated(t, self.angle, start)) / (end - start)[:, None]

    def slope(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Derivatives (n, 3) rad/s^2 of the mean rates by a common shift of start and end."""
        t, gyro = self.imu.seconds, self.imu.gyro
        return (interpolated(t, gyro, end) - interpolated(t, gyro, start)) / (end - start)[:, None]
