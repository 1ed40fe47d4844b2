"""Compiled sums over the points of LiDAR scans: see `binning`.

Points of a scan are first sorted by step of time and plane. Of those that stand together then all is alike but their
coordinates, and several are added at a time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.optim.robust_weights import weight

MOMENTS = 10  # of (1, x, y, z), lower triangle row by row
SUMS = MOMENTS + 3  # and the slant
NO_NOISE = 16.0  # a point's chi^2 beyond this comes of a poor state, or of an outlier, and has no part in the slant
NO_PIVOT = 1e-13  # of a moment: below this a pivot is rounding


class Scans(NamedTuple):
    """Points of scans and the steps of time that they fall into: start (S + 1,); first step of each scan, counted from
    its stamp, and its place among all steps (S + 1,), both a multiple of the steps of a bin."""

    start: np.ndarray
    offset_s: np.ndarray
    xyz: np.ndarray
    plane: np.ndarray
    low: np.ndarray
    steps: np.ndarray


class Cells(NamedTuple):
    """Of each step (n,): whether the LiDAR's motion is known; where the LiDAR is at its middle, seen from its bin's
    centre (turn, shift). Of each bin (m,): rotation and position of the LiDAR at its centre."""

    known: np.ndarray
    turn: np.ndarray
    shift: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


class Weights(NamedTuple):
    """Variances [m^2] of what is alike in all directions, and of what is along the beam; the loss."""

    alike: float
    along: float
    loss: int
    scale: float


@njit(cache=True, nogil=True)
def step_range(start, offset_s, per_s, each, low, count):
    """First step of each scan, counted from its stamp, and how many there are: whole bins of `each` steps."""
    for i in range(len(start) - 1):
        least, most = np.inf, -np.inf
        for n in range(start[i], start[i + 1]):
            least, most = min(least, offset_s[n]), max(most, offset_s[n])
        empty = start[i + 1] == start[i]
        low[i] = 0 if empty else each * (int(np.floor(np.float64(least) * per_s)) // each)
        count[i] = 0 if empty else each * ((int(np.floor(np.float64(most) * per_s)) - low[i]) // each + 1)


@njit(cache=True, nogil=True)
def to_centres(motion, each, ok, cells):
    """Fills `cells` for bins of `each` steps."""
    for c in range(len(ok) // each):
        m = c * each + each // 2
        R, p = motion.rotation[m], motion.position[m]
        for i in range(3):
            cells.position[c, i] = p[i]
            for j in range(3):
                cells.rotation[c, i, j] = R[i, j]
        for b in range(c * each, (c + 1) * each):
            cells.known[b] = ok[b] and ok[m]
            for i in range(3):
                cells.shift[b, i] = 0.0
                for j in range(3):
                    cells.shift[b, i] += R[j, i] * (motion.position[b, j] - p[j])
                    cells.turn[b, i, j] = 0.0
                    for k in range(3):
                        cells.turn[b, i, j] += R[k, i] * motion.rotation[b, k, j]


@njit(cache=True, nogil=True, inline="always")
def _see_plane(R, p, plane, seen):
    """seen (4,): (n . p - d, R^T n), so that seen . (1, x) is the distance of a point x in the LiDAR's frame."""
    seen[0] = 0.0
    for a in range(3):
        seen[0] += plane[a] * (p[a] - plane[3 + a])
        seen[1 + a] = R[0, a] * plane[0] + R[1, a] * plane[1] + R[2, a] * plane[2]


@njit(cache=True, nogil=True, error_model="numpy")
def _sort_scan(i, scans, per_s, n_planes, ends, points):
    """Points (4, n) of scan i: x, y, z, and how long after the middle of its step. Those of one step and plane stand
    together, and end at ends[step * n_planes + plane], where the next begin."""
    low, step_s = scans.low[i], 1.0 / per_s
    # Unsigned indices spare the test of each whether it counts from the end.
    first, last = np.uint64(scans.start[i]), np.uint64(scans.start[i + 1])
    ends[:] = 0
    for n in range(first, last):
        if scans.plane[n] >= 0:
            k = int(np.floor(np.float64(scans.offset_s[n]) * per_s)) - low
            ends[np.uint64(k * n_planes + scans.plane[n])] += 1
    before = 0
    for key in range(len(ends)):
        ends[key], before = before, before + ends[key]
    for n in range(first, last):
        if scans.plane[n] >= 0:
            offset = np.float64(scans.offset_s[n])
            k = int(np.floor(offset * per_s))
            key = np.uint64((k - low) * n_planes + scans.plane[n])
            to = np.uint64(ends[key])
            points[0, to], points[1, to], points[2, to] = scans.xyz[n, 0], scans.xyz[n, 1], scans.xyz[n, 2]
            points[3, to] = offset - (k + 0.5) * step_s
            ends[key] += 1


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _add_points(points, begin, end, turn, shift, rate, velocity, seen, weights, sums):
    """Adds the weighted points from begin to end, of one step and plane, to the sums. Only numbers within the loop, no
    arrays but the points: so the compiler makes it take several points at a time."""
    xs, ys, zs, dts = points[0, begin:end], points[1, begin:end], points[2, begin:end], points[3, begin:end]
    w0, w1, w2, v0, v1, v2 = rate[0], rate[1], rate[2], velocity[0], velocity[1], velocity[2]
    R00, R01, R02, t0 = turn[0, 0], turn[0, 1], turn[0, 2], shift[0]
    R10, R11, R12, t1 = turn[1, 0], turn[1, 1], turn[1, 2], shift[1]
    R20, R21, R22, t2 = turn[2, 0], turn[2, 1], turn[2, 2], shift[2]
    off0, n0, n1, n2 = seen[0], seen[1], seen[2], seen[3]
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = slant0 = slant1 = slant2 = 0.0
    for n in range(len(xs)):
        x, y, z, dt = np.float64(xs[n]), np.float64(ys[n]), np.float64(zs[n]), np.float64(dts[n])
        h = 0.5 * dt
        mx, my, mz = x + h * (w1 * z - w2 * y), y + h * (w2 * x - w0 * z), z + h * (w0 * y - w1 * x)
        mx, my, mz = (
            x + dt * (v0 + w1 * mz - w2 * my),
            y + dt * (v1 + w2 * mx - w0 * mz),
            z + dt * (v2 + w0 * my - w1 * mx),
        )
        x, y, z = (
            R00 * mx + R01 * my + R02 * mz + t0,
            R10 * mx + R11 * my + R12 * mz + t1,
            R20 * mx + R21 * my + R22 * mz + t2,
        )
        across = n0 * x + n1 * y + n2 * z
        off, square = off0 + across, x * x + y * y + z * z
        over = 1.0 / (weights.alike * square + weights.along * across * across)
        w = square * over
        chi2 = off * off * w
        robust = weight(weights.loss, weights.scale, chi2)[0]
        turns = robust * chi2 * weights.along * across * over if chi2 < NO_NOISE else 0.0
        slant0, slant1, slant2 = slant0 - turns * x, slant1 - turns * y, slant2 - turns * z
        w *= robust
        wx, wy, wz = w * x, w * y, w * z
        s0, s1, s2, s3, s4 = s0 + w, s1 + wx, s2 + wx * x, s3 + wy, s4 + wy * x
        s5, s6, s7, s8, s9 = s5 + wy * y, s6 + wz, s7 + wz * x, s8 + wz * y, s9 + wz * z
    own = (s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, slant0, slant1, slant2)
    for k in range(SUMS):
        sums[k] += own[k]


@njit(cache=True, nogil=True, inline="always")
def _root_in_place(M):
    """Moments (10,) -> their lower Cholesky factor; where a pivot is nothing but rounding, its column is 0."""
    for j in range(4):
        d = M[j * (j + 1) // 2 + j]
        least = NO_PIVOT * d
        for k in range(j):
            d -= M[j * (j + 1) // 2 + k] ** 2
        f = 1.0 / np.sqrt(d) if d > least else 0.0
        M[j * (j + 1) // 2 + j] = d * f
        for i in range(j + 1, 4):
            s = M[i * (i + 1) // 2 + j]
            for k in range(j):
                s -= M[i * (i + 1) // 2 + k] * M[j * (j + 1) // 2 + k]
            M[i * (i + 1) // 2 + j] = s * f


@njit(cache=True, nogil=True, inline="always")
def _bin_scan(i, scans, motion, cells, each, planes, weights, sorted_points, entries, total):
    """Entries of scan i, from `total` on, in the order of bins and planes; returns how many there are then."""
    bins, plane, count, root, slant = entries
    ends, points = sorted_points
    first, seen, sums = scans.steps[i], np.empty(4), np.empty(SUMS)
    for c in range(first // each, scans.steps[i + 1] // each):
        for q in range(len(planes)):
            number = 0
            for b in range(c * each, (c + 1) * each):
                key = (b - first) * len(planes) + q
                begin, end = ends[key - 1] if key else 0, ends[key]
                if begin == end or not cells.known[b]:
                    continue
                if number == 0:
                    _see_plane(cells.rotation[c], cells.position[c], planes[q], seen)
                    for k in range(SUMS):
                        sums[k] = 0.0
                turn, shift, rate, velocity = cells.turn[b], cells.shift[b], motion.rate[b], motion.velocity[b]
                _add_points(points, begin, end, turn, shift, rate, velocity, seen, weights, sums)
                number += end - begin
            if number:
                bins[total], plane[total], count[total] = c, q, number
                for k in range(MOMENTS):
                    root[total, k] = sums[k]
                _root_in_place(root[total])
                for k in range(3):
                    slant[total, 1 + k] = sums[MOMENTS + k]
                slant[total, 0] = -(sums[10] * seen[1] + sums[11] * seen[2] + sums[12] * seen[3])
                total += 1
    return total


@njit(cache=True, nogil=True)
def bin_scans(scans, motion, cells, each, planes, weights, per_s, entries):
    """All scans one after the other, bins of `each` steps: entries' bin, plane, count, root and slant; returns how
    many."""
    room, most, total = 0, 0, 0
    for i in range(len(scans.start) - 1):
        room = max(room, (scans.steps[i + 1] - scans.steps[i]) * len(planes))
        most = max(most, scans.start[i + 1] - scans.start[i])
    ends, points = np.empty(room, np.int64), np.empty((4, most), np.float32)
    for i in range(len(scans.start) - 1):
        own = ends[: (scans.steps[i + 1] - scans.steps[i]) * len(planes)]
        _sort_scan(i, scans, per_s, len(planes), own, points)
        # int: the literal 0 would be a type of its own, for which all is compiled once more
        total = _bin_scan(i, scans, motion, cells, each, planes, weights, (own, points), entries, int(total))
    return total


@njit(cache=True, nogil=True)
def move_to_world(scans, motion, step_s, points, seen_from):
    """World coordinates of all points, and where the LiDAR was when it saw them."""
    for i in range(len(scans.start) - 1):
        for n in range(scans.start[i], scans.start[i + 1]):
            offset = np.float64(scans.offset_s[n])
            k = int(np.floor(offset * (1.0 / step_s)))
            b, dt = scans.steps[i] + k - scans.low[i], offset - (k + 0.5) * step_s
            x, v, w = scans.xyz[n], motion.velocity[b], motion.rate[b]
            for a in range(3):
                points[n, a] = seen_from[n, a] = motion.position[b, a]
            for c in range(3):
                d, e = (c + 1) % 3, (c + 2) % 3
                turned = x[c] + dt * (w[d] * x[e] - w[e] * x[d])
                for a in range(3):
                    points[n, a] += motion.rotation[b, a, c] * (turned + dt * v[c])
                    seen_from[n, a] += motion.rotation[b, a, c] * dt * v[c]
