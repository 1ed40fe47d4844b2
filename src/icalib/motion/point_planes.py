"""Compiled loops over LiDAR points (tens of millions) and the index of the plane of each."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit

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
