"""Association of LiDAR points with planes of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.motion.point_planes import count_points
from icalib.optim.state import Entry, Key
from icalib.rig.scene import PLANE

MIN_PLANE_POINTS = 100  # points of a plane: with fewer, its normal is too uncertain to be of use


@dataclass(frozen=True)
class Clouds:
    """Index of the plane of each LiDAR point. names (P,): of the planes, different from all sensor names. plane: for
    each LiDAR (N,) int32, plane of each point, -1 for none."""

    names: tuple[str, ...]
    plane: tuple[np.ndarray, ...]

    @property
    def count(self) -> int:
        """P, the number of planes."""
        return len(self.names)

    @property
    def keys(self) -> tuple[Key, ...]:
        """Keys of the planes' values in a state."""
        return tuple((name, PLANE.name) for name in self.names)

    @property
    def recording(self) -> np.ndarray:
        """(P,) number of the recording of each plane, see `joined_clouds`."""
        numbers = (name.removeprefix("plane ").split(".") for name in self.names)
        return np.array([int(n[0]) - 1 if len(n) > 1 else 0 for n in numbers], dtype=np.int64)

    @property
    def entries(self) -> list[Entry]:
        """Layout entries of the planes."""
        return [PLANE.entry(name) for name in self.names]

    @property
    def points(self) -> np.ndarray:
        """(P,) number of points on each plane."""
        return sum((count_points(p, self.count) for p in self.plane), np.zeros(self.count, dtype=np.int64))


NO_CLOUDS = Clouds((), ())


def joined_clouds(each: Sequence[Clouds]) -> Clouds:
    """Associations of consecutive recordings as one. Each recording has its own world and planes: "plane 2.0" is the
    first plane of the second recording."""
    if len(each) == 1:
        return each[0]
    names = tuple(f"plane {r}.{own.removeprefix('plane ')}" for r, c in enumerate(each, 1) for own in c.names)
    first = np.cumsum([0, *(c.count for c in each)])
    pairs = zip(*(c.plane for c in each), strict=True)
    plane = (
        np.concatenate([np.where(p >= 0, p + n, -1) for p, n in zip(own, first, strict=False)]).astype(np.int32)
        for own in pairs
    )
    return Clouds(names, tuple(plane))


def known_planes(streams: Sequence[LidarStream]) -> Clouds:
    """The association that the streams contain, without planes of fewer than MIN_PLANE_POINTS points."""
    most = max((int(s.plane.max(initial=-1)) for s in streams), default=-1) + 1
    count = sum((count_points(s.plane, most) for s in streams), np.zeros(most, dtype=np.int64))
    used = np.flatnonzero(count >= MIN_PLANE_POINTS)
    own = np.full(most + 1, -1, dtype=np.int32)
    own[used] = np.arange(len(used))
    return Clouds(tuple(f"plane {k}" for k in used), tuple(own[s.plane] for s in streams))
