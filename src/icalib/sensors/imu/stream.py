"""The stream of an IMU."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from icalib.sensors.stream import Stream, check


@dataclass(frozen=True)
class ImuStream(Stream):
    """Readings of one IMU.

    stamps_ns (N,) int64, strictly increasing; angular rate gyro (N, 3) [rad/s] and specific force accel (N, 3) [m/s^2]
    in the IMU frame.
    """

    sensor_type: ClassVar[str] = "imu"
    gyro: np.ndarray
    accel: np.ndarray

    def __post_init__(self) -> None:
        super().__post_init__()
        n = len(self.stamps_ns)
        check(self.gyro.shape == (n, 3), f"{self.name}: gyro must have shape ({n}, 3), not {self.gyro.shape}.")
        check(self.accel.shape == (n, 3), f"{self.name}: accel must have shape ({n}, 3), not {self.accel.shape}.")
