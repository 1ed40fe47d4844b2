"""The record of IMU residuals in a result."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from icalib.sensors.records import Shapes, Successive, successive_rows

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


RECORDS = (ImuResiduals,)
