"""Compiled passes over the points of a LiDAR, tens of millions, and over which plane each lies on."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit

MAX_COARSE_POINTS = 3_000_000  # of a LiDAR, where some of its points will do
MAX_PLANE_POINTS_KEPT_WHOLE = 20_000  # points of a plane that are all looked at


@njit(cache=True, nogil=True)
def are_somewhere(xyz):
    """(N,) bool which points xyz (N, 3) are anywhere but at the LiDAR itself: finite, and not all zeros."""
    out = np.empty(len(xyz), np.bool_)
    for i in range(len(xyz)):
        size2 = xyz[i, 0] * xyz[i, 0] + xyz[i, 1] * xyz[i, 1] + xyz[i, 2] * xyz[i, 2]
        out[i] = np.isfinite(size2) and size2 > 0.0
    return out


@njit(cache=True, nogil=True)
def count_points(plane, n):
    """(n,) how many points lie on each of n planes; plane (N,), -1: on none."""
    count = np.zeros(n, dtype=np.int64)
    for q in plane:
        if q >= 0:
            count[q] += 1
    return count


@njit(cache=True, nogil=True)
def _some(plane, step, count, out):
    due = 0
    for i in range(len(plane)):
        q = plane[i]
        out[i] = q if i == due or (q >= 0 and count[q] < MAX_PLANE_POINTS_KEPT_WHOLE) else -1
        if i == due:
            due += step


def thinned(plane: np.ndarray) -> np.ndarray:
    """(N,) plane of each point, -1 for all but some of very many; by an odd step, or some lasers would be left out."""
    step = len(plane) // MAX_COARSE_POINTS | 1
    if step == 1:
        return plane
    out = np.empty_like(plane)
    _some(plane, step, count_points(plane, int(plane.max()) + 1), out)
    return out
