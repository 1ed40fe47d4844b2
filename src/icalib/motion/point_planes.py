"""Compiled loops over LiDAR points (tens of millions) and the index of the plane of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.targets.base import BOARD
from icalib.optim.state import Entry, Key, in_recording
from icalib.rig.scene import PLANE, TILT

MAX_COARSE_POINTS = 3_000_000  # points of a LiDAR that a coarse pass uses, roughly
MAX_UNTHINNED_PLANE_POINTS = 20_000  # points of a plane: planes with fewer are not thinned


@njit(cache=True, nogil=True)
def are_somewhere(xyz):
    """(N,) whether each point of xyz (N, 3) is a return: finite, and not all zeros."""
    out = np.empty(len(xyz), np.bool_)
    for i in range(len(xyz)):
        size2 = xyz[i, 0] * xyz[i, 0] + xyz[i, 1] * xyz[i, 1] + xyz[i, 2] * xyz[i, 2]
        out[i] = np.isfinite(size2) and size2 > 0.0
    return out


@njit(cache=True, nogil=True)
def count_points(plane, n):
    """Number (n,) of points on each of n planes; plane (N,), -1 for points on none."""
    count = np.zeros(n, dtype=np.int64)
    for q in plane:
        if q >= 0:
            count[q] += 1
    return count


@njit(cache=True, nogil=True)
def _some(plane, step, count, out):
    """Fills out (N,): plane of every step-th point and of all points of small planes, -1 for all other points."""
    due = 0
    for i in range(len(plane)):
        q = plane[i]
        out[i] = q if i == due or (q >= 0 and count[q] < MAX_UNTHINNED_PLANE_POINTS) else -1
        if i == due:
            due += step


def thinned(plane: np.ndarray) -> np.ndarray:
    """Plane (N,) of each point, -1 for most points of very large clouds. The step is odd, so that no laser ring is left
    out."""
    step = len(plane) // MAX_COARSE_POINTS | 1
    if step == 1:
        return plane
    out = np.empty_like(plane)
    _some(plane, step, count_points(plane, int(plane.max()) + 1), out)
    return out


# Association of LiDAR points with planes of the scene.


@dataclass(frozen=True)
class PlaneAssociation:
    """Index of the plane of each LiDAR point. names (P,): of the planes, different from all sensor names. plane: for
    each LiDAR (N,) int32, plane of each point, -1 for none. at_rest: no planes are estimated, because points lie on the
    target, or on surfaces that LiDARs share.

    sheets: recordings in which points lie on the sheet of the target's reference body. These planes, which are those of
    the cameras' target, have the numbers from P on."""

    names: tuple[str, ...]
    plane: tuple[np.ndarray, ...]
    at_rest: bool = False
    sheets: tuple[int, ...] = ()

    @property
    def count(self) -> int:
        """P, the number of planes."""
        return len(self.names)

    @property
    def keys(self) -> tuple[Key, ...]:
        """Keys of the planes' values in a state."""
        return tuple((name, PLANE.name) for name in self.names)

    @property
    def surfaces(self) -> tuple[Key, ...]:
        """Keys of what `plane` counts: of the planes, then of the attitudes of the sheets."""
        return (*self.keys, *((in_recording(BOARD, r), TILT.name) for r in self.sheets))

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
        return self._counts[:, : self.count].sum(axis=0)

    @property
    def points_on_sheets(self) -> np.ndarray:
        """(L, sheets) number of points of each LiDAR on each sheet."""
        return self._counts[:, self.count :]

    @cached_property
    def _counts(self) -> np.ndarray:
        """(L, P + sheets) number of points of each LiDAR on each plane and sheet."""
        n = self.count + len(self.sheets)
        return np.array([count_points(p, n) for p in self.plane], dtype=np.int64).reshape(len(self.plane), n)


NO_ASSOCIATION = PlaneAssociation((), ())
AT_REST = PlaneAssociation((), (), at_rest=True)


def joined_associations(each: Sequence[PlaneAssociation]) -> PlaneAssociation:
    """Associations of consecutive recordings as one. Each recording has its own world and planes: "plane 2.0" is the
    first plane of the second recording."""
    if len(each) == 1:
        return each[0]
    names = tuple(f"plane {r}.{name.removeprefix('plane ')}" for r, c in enumerate(each, 1) for name in c.names)
    first = np.cumsum([0, *(c.count for c in each)])
    sheets = tuple(r for r, c in enumerate(each) if c.sheets)
    number = {r: len(names) + k for k, r in enumerate(sheets)}
    by_lidar = zip(*(c.plane for c in each), strict=True)
    plane = (
        np.concatenate(
            [
                np.where(p < 0, -1, np.where(p < c.count, p + first[r], number.get(r, -1)))
                for r, (p, c) in enumerate(zip(parts, each, strict=True))
            ]
        ).astype(np.int32)
        for parts in by_lidar
    )
    return PlaneAssociation(names, tuple(plane), sheets=sheets)
