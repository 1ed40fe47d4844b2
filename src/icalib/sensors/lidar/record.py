"""Residuals of points on planes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from icalib.sensors.records import Shapes, Successive

SAME_WALL_S = 0.3  # within which two points of a plane are neighbours in time; a LiDAR turns several times a second


@dataclass(frozen=True)
class LidarResiduals:
    """Points of one LiDAR on planes, evenly thinned. residual = n . x - d [m], positive on the normal's side.

    points_read and points_used count all points of the recording and of the estimate. `first_world` and
    `first_residual` are of the initial guess: points, and their residuals from the planes that fit them best.
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
    seconds: np.ndarray  # (N,) of each point, imu clock, s since the first IMU stamp; see RecordingSpan for several
    plane: np.ndarray  # (N,) int32, index into the calibration's planes
    distance: np.ndarray  # (N,) float32 m, from the LiDAR
    sigma: np.ndarray  # (N,) float32 m, standard deviation that the residual was given
    world: np.ndarray  # (N, 3) float32 m, world frame
    residual: np.ndarray  # (N,) float32 m
    first_world: np.ndarray  # (N, 3) float32 m
    first_residual: np.ndarray  # (N,) float32 m

    def normalised(self) -> dict[str, np.ndarray]:
        """Of all points."""
        return {"points": self.residual / self.sigma}

    def successive(self) -> dict[str, Successive]:
        """A point's next one is on the same plane, and soon after."""
        order = np.lexsort((self.seconds, self.plane))
        follows = (np.diff(self.plane[order]) == 0) & (np.diff(self.seconds[order]) < SAME_WALL_S)
        return {self.kind: Successive((self.residual[order] / self.sigma[order])[:, None], follows)}


RECORDS = (LidarResiduals,)
