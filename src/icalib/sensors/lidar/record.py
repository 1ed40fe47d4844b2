"""The record of residuals of points on planes in a result."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from icalib.sensors.records import Shapes, Successive

MAX_SUCCESSIVE_S = 0.3  # between successive points of a plane; longer than a revolution of a spinning LiDAR


@dataclass(frozen=True)
class LidarResiduals:
    """Points of one LiDAR on planes, evenly thinned. residual = n . x - d [m], positive on the side of the normal.

    points_read: number of points in the recording; points_used: number of points in the estimate. first_world and
    first_residual are points at the initial guess, and their distances from the planes that fit these points best.
    """

    kind: str = field(default="points", init=False)
    shapes: ClassVar[Shapes] = {
        "seconds": ("f", "n"),
        "plane": ("iu", "n"),
        "distance": ("f", "n"),
        "sigma": ("f", "n"),
        "world": ("f", "n", 3),
        "residual": ("f", "n"),
        "first_world": ("f", "n", 3),
        "first_residual": ("f", "n"),
    }

    sensor: str
    scans: int
    points_read: int
    points_used: int
    seconds: np.ndarray  # (N,) s since the first IMU stamp, IMU clock; several recordings: see RecordingSpan
    plane: np.ndarray  # (N,) int32, index into the calibration's planes
    distance: np.ndarray  # (N,) float32 m, from the LiDAR
    sigma: np.ndarray  # (N,) float32 m, assumed standard deviation of the residual
    world: np.ndarray  # (N, 3) float32 m, world frame
    residual: np.ndarray  # (N,) float32 m
    first_world: np.ndarray  # (N, 3) float32 m
    first_residual: np.ndarray  # (N,) float32 m

    def normalised(self) -> dict[str, np.ndarray]:
        """Residuals (N,) over their standard deviations, by kind."""
        return {"points": self.residual / self.sigma}

    def successive(self) -> dict[str, Successive]:
        """Normalised residuals by plane and time. Successive points are on one plane, within MAX_SUCCESSIVE_S."""
        order = np.lexsort((self.seconds, self.plane))
        follows = (np.diff(self.plane[order]) == 0) & (np.diff(self.seconds[order]) < MAX_SUCCESSIVE_S)
        return {self.kind: Successive((self.residual[order] / self.sigma[order])[:, None], follows)}


RECORDS = (LidarResiduals,)
