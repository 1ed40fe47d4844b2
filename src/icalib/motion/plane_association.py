"""Association of LiDAR points with planes of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icalib.motion.point_planes import count_points
from icalib.optim.state import Entry, Key
from icalib.rig.scene import PLANE


@dataclass(frozen=True)
class PlaneAssociation:
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
        """(P,) number of the recording of each plane, see `joined_associations`."""
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


NO_ASSOCIATION = PlaneAssociation((), ())


def joined_associations(each: Sequence[PlaneAssociation]) -> PlaneAssociation:
    """Associations of consecutive recordings as one. Each recording has its own world and planes: "plane 2.0" is the
    first plane of the second recording."""
    if len(each) == 1:
        return each[0]
    names = tuple(f"plane {r}.{name.removeprefix('plane ')}" for r, c in enumerate(each, 1) for name in c.names)
    first = np.cumsum([0, *(c.count for c in each)])
    by_lidar = zip(*(c.plane for c in each), strict=True)
    plane = (
        np.concatenate([np.where(p >= 0, p + n, -1) for p, n in zip(parts, first, strict=False)]).astype(np.int32)
        for parts in by_lidar
    )
    return PlaneAssociation(names, tuple(plane))
