"""The stream of a LiDAR: scans of points."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from icalib.sensors.stream import Shapes, Stream, Successive, check, check_groups


@dataclass(frozen=True)
class LidarStream(Stream):
    """S scans of one LiDAR with N points.

    stamps_ns (S,) int64: strictly increasing; start (S + 1,) int64: points of scan i are start[i]:start[i + 1];
    offset_s (N,) float32: instant of each point since the stamp of its scan; xyz (N, 3) float32 [m]: in the frame of
    the LiDAR at the instant of the point; plane (N,) int32: known plane of each point, -1: unknown.
    """

    sensor_type: ClassVar[str] = "lidar"
    start: np.ndarray
    offset_s: np.ndarray
    xyz: np.ndarray
    plane: np.ndarray

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = {"offset_s": len(self.offset_s), "xyz": len(self.xyz), "plane": len(self.plane)}
        check_groups(self.name, self.stamps_ns, self.start, "points", counts)
        check(self.xyz.shape[1:] == (3,), f"{self.name}: xyz must have shape (N, 3), not {self.xyz.shape}.")
        for column, array in (("offset_s", self.offset_s), ("xyz", self.xyz)):
            check(array.dtype == np.float32, f"{self.name}: {column} must be float32.")
        check(self.plane.dtype == np.int32, f"{self.name}: plane must be int32.")

    def some(self, kept: np.ndarray) -> LidarStream:
        """The stream with the points selected by the mask `kept` (N,). All scans stay, even without points."""
        return self if kept.all() else self.numbered(np.flatnonzero(kept))

    def numbered(self, points: np.ndarray) -> LidarStream:
        """The stream with the points numbered `points` (n,), increasing. All scans stay, even without points."""
        columns = {name: getattr(self, name)[points] for name in ("offset_s", "xyz", "plane")}
        return replace(self, start=np.searchsorted(points, self.start), **columns)

    def of_scans(self, kept: np.ndarray, stamps_ns: np.ndarray) -> LidarStream:
        """The scans selected by the mask `kept`, with other stamps (n,)."""
        some = self.some(np.repeat(kept, np.diff(self.start)))
        return replace(some, stamps_ns=stamps_ns, start=np.append(some.start[:-1][kept], some.start[-1]))

    def unassociated(self) -> LidarStream:
        """The stream without known planes."""
        return replace(self, plane=np.full(len(self.plane), -1, np.int32))


# The record of residuals of points on planes in a result.

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
