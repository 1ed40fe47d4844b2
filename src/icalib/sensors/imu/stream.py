"""The stream of an IMU."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from icalib.sensors.stream import Shapes, Stream, Successive, check, successive_rows


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


# The record of IMU residuals in a result.

# Names of the blocks of three columns of the residuals.
BLOCKS = ("rotation", "velocity", "position", "gyroscope walk", "accelerometer walk")


@dataclass(frozen=True)
class ImuResiduals:
    """Whitened residuals of the IMU factor, a row per interval between keyframes.

    Columns: rotation, velocity, position, gyroscope walk, accelerometer walk, three each.
    """

    kind: str = field(default="intervals", init=False)
    shapes: ClassVar[Shapes] = {"seconds": ("f", "n"), "whitened": ("f", "n", 15)}

    sensor: str
    seconds: np.ndarray  # (K - 1,) start of each interval
    whitened: np.ndarray  # (K - 1, 15)

    def normalised(self) -> dict[str, np.ndarray]:
        """Empty: the trajectory fits the IMU closely, so that its residuals are smaller than its noise."""
        return {}

    def successive(self) -> dict[str, Successive]:
        """Pairs of residuals of successive intervals, for each block of `BLOCKS`."""
        return successive_rows(BLOCKS, self.whitened)
