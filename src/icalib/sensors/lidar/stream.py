"""What a LiDAR measured: points, scan by scan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from icalib.sensors.stream import Stream, check, check_groups


@dataclass(frozen=True)
class LidarStream(Stream):
    """Points of one LiDAR, scan by scan.

    stamps_ns (S,) int64, one per scan, strictly increasing; start (S + 1,) int64, points of scan i are
    start[i]:start[i+1]; offset_s (N,) float32, instant of each point from its scan's stamp; xyz (N, 3) float32 [m] in
    the sensor's frame at the point's own instant; plane (N,) int32, the plane that it is known to lie on, -1: unknown.
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
        """The points in `kept` (N,) bool; all scans stay, if empty."""
        if kept.all():
            return self
        start = np.concatenate([[0], np.cumsum(kept)])[self.start].astype(np.int64)
        columns = {name: getattr(self, name)[kept] for name in ("offset_s", "xyz", "plane")}
        return replace(self, start=start, **columns)

    def unassociated(self) -> LidarStream:
        """The same points, of which nobody knows on what planes they lie."""
        return replace(self, plane=np.full(len(self.plane), -1, np.int32))
