"""Compiled parts of the search for planes: moments of voxels, growing regions, points to planes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit

MOMENTS = 10  # 1; x, xx; y, yx, yy; z, zx, zy, zz
LARGEST_TURN = 0.26  # rad between the normal of a voxel and its region: those of voxels are rough
EXCLUSIVE_GATES = 1.6  # gates between a point and planes that are not its own
REGION_REACH = 2.5  # standard deviations between a voxel's centre and the plane of its region


OUTSIDE, NEAR, OWN = 0, 1, 2  # what a cell is to its plane


class Voxels(NamedTuple):
    """moments (V, 10) about the world's origin; normal (V, 3), towards whoever saw it; centre (V, 3); sigma (V,) [m]
    across; neighbour (V, 26), -1: none; flat: whether it can belong to a region."""

    moments: np.ndarray
    normal: np.ndarray
    centre: np.ndarray
    sigma: np.ndarray
    neighbour: np.ndarray
    flat: np.ndarray


class OccupancyGrid(NamedTuple):
    """Where planes (P, 6) reach: squares of a grid along their axes (P, 2, 3) from `low` (P, 2), size (P, 2) of them;
    those of plane q begin at first[q] of `use`: OUTSIDE, NEAR (it may be there: no other may take the points), OWN."""

    planes: np.ndarray
    axes: np.ndarray
    low: np.ndarray
    size: np.ndarray
    first: np.ndarray
    use: np.ndarray
    edge_m: float


@njit(cache=True, nogil=True)
def sum_voxels(points, seen_from, variance, which, moments, towards, total):
    """Adds points (N, 3) to moments (V, 10), directions to whoever saw them (V, 3), and variances (V,)."""
    for n in range(len(points)):
        v = which[n]
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        a, b, c = seen_from[n, 0] - x, seen_from[n, 1] - y, seen_from[n, 2] - z
        f = 1.0 / np.sqrt(a * a + b * b + c * c)
        towards[v, 0] += f * a
        towards[v, 1] += f * b
        towards[v, 2] += f * c
        total[v] += variance[n]
        row = (1.0, x, x * x, y, y * x, y * y, z, z * x, z * y, z * z)
        for k in range(MOMENTS):
            moments[v, k] += row[k]


@njit(cache=True, nogil=True)
def fit(moments, normal, centre):
    """Least-squares plane of moments (10,): fills its centre and normal, whose side is kept. Returns the variance
    across."""
    n = moments[0]
    for i, k in enumerate((1, 3, 6)):
        centre[i] = moments[k] / n
    x, y, z = centre
    S = np.empty((3, 3))
    S[0, 0], S[1, 1], S[2, 2] = moments[2] / n - x * x, moments[5] / n - y * y, moments[9] / n - z * z
    S[1, 0], S[2, 0], S[2, 1] = moments[4] / n - y * x, moments[7] / n - z * x, moments[8] / n - z * y
    S[0, 1], S[0, 2], S[1, 2] = S[1, 0], S[2, 0], S[2, 1]
    values, vectors = np.linalg.eigh(S)
    side = normal[0] * vectors[0, 0] + normal[1] * vectors[1, 0] + normal[2] * vectors[2, 0]
    for i in range(3):
        normal[i] = vectors[i, 0] if side >= 0.0 else -vectors[i, 0]
    return values[0]


@njit(cache=True, nogil=True)
def _fits(v, voxels, normal, centre):
    """Whether voxel v lies on the plane of a region, and its normal points to the same side."""
    cosine, distance = 0.0, 0.0
    for i in range(3):
        cosine += normal[i] * voxels.normal[v, i]
        distance += normal[i] * (voxels.centre[v, i] - centre[i])
    return cosine > np.cos(LARGEST_TURN) and abs(distance) < REGION_REACH * voxels.sigma[v]


@njit(cache=True, nogil=True)
def grow(voxels, seeds, region):
    """Fills region (V,), -1: none, from `seeds` on in their order; returns how many there are."""
    count, queue = 0, np.empty(len(region), np.int64)
    total, normal, centre = np.empty(MOMENTS), np.empty(3), np.empty(3)
    for s in seeds:
        if region[s] >= 0 or not voxels.flat[s]:
            continue
        region[s], queue[0], size, done, refit = count, s, 1, 0, 2
        for i in range(MOMENTS):  # in loops: array expressions take seconds to compile
            total[i] = voxels.moments[s, i]
        for i in range(3):
            normal[i], centre[i] = voxels.normal[s, i], voxels.centre[s, i]
        while done < size:
            for v in voxels.neighbour[queue[done]]:
                if v < 0 or region[v] >= 0 or not voxels.flat[v] or not _fits(v, voxels, normal, centre):
                    continue
                region[v], queue[size] = count, v
                size += 1
                for i in range(MOMENTS):
                    total[i] += voxels.moments[v, i]
                if size >= refit:
                    fit(total, normal, centre)
                    refit = size + 1 + size // 8
            done += 1
        count += 1
    return count


@njit(cache=True, nogil=True)
def _reach(q, x, y, z, cells):
    """The cell of plane q that a point is in, -1: outside."""
    p, k = cells.planes[q], 0
    for i in range(2):
        a = cells.axes[q, i]
        u = a[0] * (x - p[3]) + a[1] * (y - p[4]) + a[2] * (z - p[5])
        c = int(np.floor((u - cells.low[q, i]) / cells.edge_m))
        if c < 0 or c >= cells.size[q, i]:
            return -1
        k = k * cells.size[q, i] + c
    return cells.first[q] + k if cells.use[cells.first[q] + k] != OUTSIDE else -1


@njit(cache=True, nogil=True)
def associate(points, seen_from, variance, cells, gate, least_cosine, plane, cell, distance):
    """Associates each point with the plane within `gate` standard deviations that is seen from the point's side; -1: no
    plane, or a second one is near, even in a grazing beam (the floor, at the foot of a far wall). Fills `cell` and
    `distance` of each point.

    The cell is that of the point where the beam meets the plane. The measured point itself would bias the plane: noise
    along the beam moves points off an edge, or towards another plane, more often in one direction than in the other
    (1.5 mm for small faces)."""
    count = len(cells.planes)
    equation, r = np.empty((4, count)), np.empty(count)  # by rows: the loop over all planes is then a few instructions
    for q in range(count):
        p = cells.planes[q]
        equation[0, q], equation[1, q], equation[2, q] = p[0], p[1], p[2]
        equation[3, q] = p[0] * p[3] + p[1] * p[4] + p[2] * p[5]
    for n in range(len(points)):
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        a, b, c = seen_from[n, 0] - x, seen_from[n, 1] - y, seen_from[n, 2] - z
        far = np.sqrt(a * a + b * b + c * c)
        reach, least = gate * np.sqrt(variance[n]), least_cosine * far
        found, q_own, k_own, s_own = 0, -1, -1, 0.0
        for q in range(count):
            r[q] = equation[0, q] * x + equation[1, q] * y + equation[2, q] * z - equation[3, q]
        for q in range(count):
            if abs(r[q]) > reach:
                continue
            facing = equation[0, q] * a + equation[1, q] * b + equation[2, q] * c
            if facing < least:
                continue
            s = -r[q] / facing
            k = _reach(q, x + s * a, y + s * b, z + s * c, cells)
            if k >= 0:
                found += 1
                q_own, k_own, s_own = q, k, s
        plane[n] = -1
        if found == 1 and cells.use[k_own] == OWN:
            foot = x + s_own * a, y + s_own * b, z + s_own * c
            near, longest = EXCLUSIVE_GATES * reach, EXCLUSIVE_GATES * reach + abs(s_own) * far
            for q in range(count):
                if abs(r[q]) > longest or q == q_own:
                    continue
                facing = equation[0, q] * a + equation[1, q] * b + equation[2, q] * c
                if facing > 0.0 and abs(r[q] + s_own * facing) <= near and _reach(q, *foot, cells) >= 0:
                    break
            else:
                plane[n], cell[n], distance[n] = q_own, k_own, r[q_own]


@njit(cache=True, nogil=True)
def sum_cells(points, variance, plane, cell, distance, stats, moments):
    """Of each cell number, sum and sum of squares of whitened distances (C, 3); of each plane its moments (P, 10)."""
    for n in range(len(points)):
        q = plane[n]
        if q < 0:
            continue
        r = distance[n] / np.sqrt(variance[n])
        stats[cell[n], 0] += 1.0
        stats[cell[n], 1] += r
        stats[cell[n], 2] += r * r
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        row = (1.0, x, x * x, y, y * x, y * y, z, z * x, z * y, z * z)
        for k in range(MOMENTS):
            moments[q, k] += row[k] / variance[n]
