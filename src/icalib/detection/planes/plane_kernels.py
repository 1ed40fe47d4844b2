"""Compiled parts of the search for planes: moments of voxels, growth of regions, association of points with planes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit

MOMENTS = 10  # sums of 1; x, xx; y, yx, yy; z, zx, zy, zz
LARGEST_TURN = 0.26  # rad: largest angle between the normals of a voxel, which is inaccurate, and of its region
EXCLUSIVE_GATES = 1.6  # gates: least distance between a point and any other plane
REGION_REACH = 2.5  # standard deviations: largest distance between a voxel's centre and the plane of its region


OUTSIDE, NEAR, INSIDE = 0, 1, 2  # use of a cell by its plane


class Voxels(NamedTuple):
    """moments (V, 10): about the world's origin; normal (V, 3): towards the sensor; centre (V, 3) m; sigma (V,) m:
    standard deviation of the points; neighbour (V, 26): indices, -1 for none; flat (V,): whether the voxel can belong
    to a region."""

    moments: np.ndarray
    normal: np.ndarray
    centre: np.ndarray
    sigma: np.ndarray
    neighbour: np.ndarray
    flat: np.ndarray


class OccupancyGrid(NamedTuple):
    """Cells of P planes (P, 6): normal and point. The cells of plane q are squares of edge edge_m on a grid along
    axes[q] (2, 3). The grid starts at low[q] (2,) m from the point and has size[q] (2,) cells.

    Entries of `use` from first[q] on: OUTSIDE the plane; NEAR, where the plane may be, so that no other plane gets the
    points; INSIDE, cells whose points belong to the plane.
    """

    planes: np.ndarray
    axes: np.ndarray
    low: np.ndarray
    size: np.ndarray
    first: np.ndarray
    use: np.ndarray
    edge_m: float


@njit(cache=True, nogil=True)
def sum_voxels(points, origins, variance, which, moments, towards, total):
    """Adds the moments of points (N, 3) to moments (V, 10), unit vectors to the sensor to towards (V, 3), and variances
    to total (V,). origins (N, 3): position of the sensor at each point; which (N,): voxel of each point."""
    for n in range(len(points)):
        v = which[n]
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        a, b, c = origins[n, 0] - x, origins[n, 1] - y, origins[n, 2] - z
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
    """Least-squares plane of moments (10,): fills centre and normal, which keeps its side. Returns the variance along
    the normal."""
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
    """Whether voxel v lies on the plane of a region, with its normal on the same side."""
    cosine, distance = 0.0, 0.0
    for i in range(3):
        cosine += normal[i] * voxels.normal[v, i]
        distance += normal[i] * (voxels.centre[v, i] - centre[i])
    return cosine > np.cos(LARGEST_TURN) and abs(distance) < REGION_REACH * voxels.sigma[v]


@njit(cache=True, nogil=True)
def grow(voxels, seeds, region):
    """Fills region (V,) with the region of each voxel, -1 for none, from `seeds` in their order; returns the number of
    regions."""
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
    """Cell of plane q that contains the point, -1 if it is outside of the plane's cells."""
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
def _fill_equations(planes, equation):
    """Fills equation (4, P): unit normals and distances [m] from the origin of planes (P, 6), normal and point. There
    is one row for each coefficient, so that loops over planes are vectorised."""
    for q in range(len(planes)):
        p = planes[q]
        equation[0, q], equation[1, q], equation[2, q] = p[0], p[1], p[2]
        equation[3, q] = p[0] * p[3] + p[1] * p[4] + p[2] * p[5]


@njit(cache=True, nogil=True)
def associate(points, origins, variance, cells, gate, least_cosine, plane, cell, distance):
    """Associates each point with the plane within `gate` standard deviations that faces the sensor. The plane is -1 if
    there is none, or if a second plane is near, even one that the beam grazes (the floor at the foot of a far wall).
    Fills `plane`, `cell` and `distance` of each point. origins (N, 3) m: position of the sensor at each point.

    The cell is that of the intersection of beam and plane. The measured point would bias the plane by 1.5 mm for small
    faces. Noise along the beam moves points across an edge, or towards another plane, more often in one direction than
    in the other.
    """
    count = len(cells.planes)
    equation, r = np.empty((4, count)), np.empty(count)
    _fill_equations(cells.planes, equation)
    # The loops over planes are not kernels of their own: calls with arrays for each point cost 30 % of the time.
    for n in range(len(points)):
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        a, b, c = origins[n, 0] - x, origins[n, 1] - y, origins[n, 2] - z
        far = np.sqrt(a * a + b * b + c * c)
        reach, least = gate * np.sqrt(variance[n]), least_cosine * far
        n_hits, q_hit, k_hit, s_hit = 0, -1, -1, 0.0
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
                n_hits += 1
                q_hit, k_hit, s_hit = q, k, s
        plane[n] = -1
        if n_hits == 1 and cells.use[k_hit] == INSIDE:
            foot = x + s_hit * a, y + s_hit * b, z + s_hit * c
            near, longest = EXCLUSIVE_GATES * reach, EXCLUSIVE_GATES * reach + abs(s_hit) * far
            for q in range(count):
                if abs(r[q]) > longest or q == q_hit:
                    continue
                facing = equation[0, q] * a + equation[1, q] * b + equation[2, q] * c
                if facing > 0.0 and abs(r[q] + s_hit * facing) <= near and _reach(q, *foot, cells) >= 0:
                    break
            else:
                plane[n], cell[n], distance[n] = q_hit, k_hit, r[q_hit]


@njit(cache=True, nogil=True)
def sum_cells(points, variance, plane, cell, distance, stats, moments):
    """Adds to stats (C, 3) number, sum and sum of squares of the whitened distances in each cell; and to moments (P,
    10) the moments of each plane's points, weighted by the inverse variance."""
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
