"""What is left of a robot's measurements beside images: points of LiDARs on planes, turns of wheels, and poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Plane:
    """A plane that points of LiDARs lie on. World frame: unit normal (3,) and a point (3,) on it [m]; count: of points,
    all LiDARs together."""

    name: str
    normal: np.ndarray
    point: np.ndarray
    count: int


@dataclass(frozen=True)
class LidarResiduals:
    """Points of one LiDAR on planes, evenly thinned. residual = n . x - d [m], positive on the normal's side.

    points_read and points_used are of the recording and of the estimate, thinned by nothing. What is called `first` is
    as the first guess had it: points, and their residuals from planes of their own that fit them best.
    """

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


@dataclass(frozen=True)
class WheelResiduals:
    """Residuals (predicted - measured) of one set of wheels, one row a stretch between nodes.

    labels, units (m,): of the columns; slip is measured to be 0.
    """

    sensor: str
    labels: tuple[str, ...]
    units: tuple[str, ...]  # rad, m
    seconds: np.ndarray  # (n,) start of each stretch, imu clock, s since the first IMU stamp
    residual: np.ndarray  # (n, m)
    whitened: np.ndarray  # (n, m)


@dataclass(frozen=True)
class PoseResiduals:
    """Residuals (predicted - measured) of one pose sensor: rotation about its own axes, position along those in which
    it was measured. A row is a pose, or of relative poses a stretch between two.

    labels, units (6,): of the columns.
    """

    sensor: str
    labels: tuple[str, ...]
    units: tuple[str, ...]  # rad, m
    seconds: np.ndarray  # (n,) of each pose or start of each stretch, imu clock, s since the first IMU stamp
    residual: np.ndarray  # (n, 6)
    whitened: np.ndarray  # (n, 6)
