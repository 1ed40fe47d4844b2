"""Compiled sums over the points of LiDAR scans: see `binning`.

The points of a scan are sorted by time step and plane first. Points of one step and plane share pose, twist and plane,
so the inner loop works on their coordinates alone and is vectorised.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.optim.robust_weights import weight

N_MOMENTS = 10  # products of (1, x, y, z), lower triangle row by row
N_SUMS = N_MOMENTS + 3  # the moments, then the gradient of the incidence term
MAX_INCIDENCE_CHI2 = 16.0  # 4 sigma; larger values do not enter the incidence term: outliers, or an inaccurate state
MIN_PIVOT = 1e-13  # relative to the diagonal moment; a smaller pivot is a rounding error of float64


class Scans(NamedTuple):
    """S scans of N points, and the time steps into which the points fall.

    start (S + 1,): points of scan i are start[i]:start[i + 1]; offset_s (N,): time since the stamp of the scan; xyz
    (N, 3) [m]; plane (N,): plane of each point, -1: none. first_step (S,): number of the first step of a scan, counted
    from its stamp. step_start (S + 1,): position of this step among all steps. Both are multiples of the steps per bin.
    """

    start: np.ndarray
    offset_s: np.ndarray
    xyz: np.ndarray
    plane: np.ndarray
    first_step: np.ndarray
    step_start: np.ndarray


class BinPoses(NamedTuple):
    """Poses of the LiDAR at n steps and m bins. known (n,) bool: IMU readings cover the step and its bin. R_bin_step
    (n, 3, 3), p_bin_step (n, 3) [m]: pose at the middle of each step, in the frame of the LiDAR at the centre of its
    bin. R_world_bin (m, 3, 3), p_world_bin (m, 3) [m]: pose at the centre of each bin."""

    known: np.ndarray
    R_bin_step: np.ndarray
    p_bin_step: np.ndarray
    R_world_bin: np.ndarray
    p_world_bin: np.ndarray


class RangeWeights(NamedTuple):
    """Noise and robust loss of points. variance [m^2]: isotropic part of the variance of the distance from a plane;
    beam_variance [m^2]: variance along the beam; loss: number of the robust loss; scale: in standard deviations."""

    variance: float
    beam_variance: float
    loss: int
    scale: float


@njit(cache=True, nogil=True)
def step_range(start, offset_s, per_s, per_bin, first, count):
    """Fills first (S,), the first step of each scan counted from its stamp, and count (S,), its number of steps. Scans
    have whole bins of per_bin steps; per_s: steps per second. A scan without points has no step."""
    for i in range(len(start) - 1):
        least, most = np.inf, -np.inf
        for n in range(start[i], start[i + 1]):
            least, most = min(least, offset_s[n]), max(most, offset_s[n])
        empty = start[i + 1] == start[i]
        first[i] = 0 if empty else per_bin * (int(np.floor(np.float64(least) * per_s)) // per_bin)
        count[i] = 0 if empty else per_bin * ((int(np.floor(np.float64(most) * per_s)) - first[i]) // per_bin + 1)


@njit(cache=True, nogil=True)
def fill_bin_poses(motion, per_bin, ok, poses):
    """Fills `poses` for bins of per_bin steps. motion: `Sweep` at the middles of the n steps; ok (n,) bool: IMU
    readings cover the step."""
    for c in range(len(ok) // per_bin):
        m = c * per_bin + per_bin // 2
        R, p = motion.rotation[m], motion.position[m]
        for i in range(3):
            poses.p_world_bin[c, i] = p[i]
            for j in range(3):
                poses.R_world_bin[c, i, j] = R[i, j]
        for b in range(c * per_bin, (c + 1) * per_bin):
            poses.known[b] = ok[b] and ok[m]
            for i in range(3):
                poses.p_bin_step[b, i] = 0.0
                for j in range(3):
                    poses.p_bin_step[b, i] += R[j, i] * (motion.position[b, j] - p[j])
                    poses.R_bin_step[b, i, j] = 0.0
                    for k in range(3):
                        poses.R_bin_step[b, i, j] += R[k, i] * motion.rotation[b, k, j]


@njit(cache=True, nogil=True, inline="always")
def _fill_distance_at(R, p, plane, m):
    """Fills m (4,) = (n . p - d, R^T n), such that m . (1, x) is the distance [m] of point x, in the LiDAR's frame,
    from the plane (6,): normal n, point."""
    m[0] = 0.0
    for a in range(3):
        m[0] += plane[a] * (p[a] - plane[3 + a])
        m[1 + a] = R[0, a] * plane[0] + R[1, a] * plane[1] + R[2, a] * plane[2]


@njit(cache=True, nogil=True, error_model="numpy")
def _sort_scan(i, scans, per_s, n_planes, ends, points):
    """Sorts the points of scan i by step and plane (counting sort).

    Fills points (4, n): x, y, z [m], and time since the middle of the step [s]; and ends: the group of a step and plane
    ends before ends[step * n_planes + plane], where the next group begins.
    """
    first_step, step_s = scans.first_step[i], 1.0 / per_s
    # Unsigned indices spare the test whether an index counts from the end.
    first, last = np.uint64(scans.start[i]), np.uint64(scans.start[i + 1])
    ends[:] = 0
    for n in range(first, last):
        if scans.plane[n] >= 0:
            k = int(np.floor(np.float64(scans.offset_s[n]) * per_s)) - first_step
            ends[np.uint64(k * n_planes + scans.plane[n])] += 1
    before = 0
    for key in range(len(ends)):
        ends[key], before = before, before + ends[key]
    for n in range(first, last):
        if scans.plane[n] >= 0:
            offset = np.float64(scans.offset_s[n])
            k = int(np.floor(offset * per_s))
            key = np.uint64((k - first_step) * n_planes + scans.plane[n])
            to = np.uint64(ends[key])
            points[0, to], points[1, to], points[2, to] = scans.xyz[n, 0], scans.xyz[n, 1], scans.xyz[n, 2]
            points[3, to] = offset - (k + 0.5) * step_s
            ends[key] += 1


@njit(cache=True, nogil=True, inline="always")
def _moved_by_twist(x, y, z, dt, rate, velocity):
    """Point (x, y, z), measured dt seconds after the middle of its step, in the LiDAR's frame at that middle. The twist
    is integrated to second order; rate [rad/s], velocity [m/s] of the LiDAR in LiDAR axes."""
    (w0, w1, w2), (v0, v1, v2), h = rate, velocity, 0.5 * dt
    mx, my, mz = x + h * (w1 * z - w2 * y), y + h * (w2 * x - w0 * z), z + h * (w0 * y - w1 * x)
    return (
        x + dt * (v0 + w1 * mz - w2 * my),
        y + dt * (v1 + w2 * mx - w0 * mz),
        z + dt * (v2 + w0 * my - w1 * mx),
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _add_points(points, begin, end, R, p, rate, velocity, m, weights, sums):
    """Adds the weighted points begin:end, of one time step of a scan and one plane, to sums (13,), see N_SUMS.

    R, p: pose of the LiDAR in the middle of the step, relative to that in the middle of its bin; rate, velocity: its
    twist; m (4,): distance from the plane, see
    `_fill_distance_at`. The loop holds scalars only, so that the compiler vectorises it.
    """
    xs, ys, zs, dts = points[0, begin:end], points[1, begin:end], points[2, begin:end], points[3, begin:end]
    rate, velocity = (rate[0], rate[1], rate[2]), (velocity[0], velocity[1], velocity[2])
    R00, R01, R02, p0 = R[0, 0], R[0, 1], R[0, 2], p[0]
    R10, R11, R12, p1 = R[1, 0], R[1, 1], R[1, 2], p[1]
    R20, R21, R22, p2 = R[2, 0], R[2, 1], R[2, 2], p[2]
    m0, n0, n1, n2 = m[0], m[1], m[2], m[3]
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = g0 = g1 = g2 = 0.0
    for n in range(len(xs)):
        x, y, z, dt = np.float64(xs[n]), np.float64(ys[n]), np.float64(zs[n]), np.float64(dts[n])
        a, b, c = _moved_by_twist(x, y, z, dt, rate, velocity)
        x, y = R00 * a + R01 * b + R02 * c + p0, R10 * a + R11 * b + R12 * c + p1
        z = R20 * a + R21 * b + R22 * c + p2
        across = n0 * x + n1 * y + n2 * z
        distance, square = m0 + across, x * x + y * y + z * z
        over = 1.0 / (weights.variance * square + weights.beam_variance * across * across)
        w = square * over
        chi2 = distance * distance * w
        robust = weight(weights.loss, weights.scale, chi2)[0]
        g = robust * chi2 * weights.beam_variance * across * over if chi2 < MAX_INCIDENCE_CHI2 else 0.0
        g0, g1, g2 = g0 - g * x, g1 - g * y, g2 - g * z
        w *= robust
        wx, wy, wz = w * x, w * y, w * z
        s0, s1, s2, s3, s4 = s0 + w, s1 + wx, s2 + wx * x, s3 + wy, s4 + wy * x
        s5, s6, s7, s8, s9 = s5 + wy * y, s6 + wz, s7 + wz * x, s8 + wz * y, s9 + wz * z
    added = (s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, g0, g1, g2)
    for k in range(N_SUMS):
        sums[k] += added[k]


@njit(cache=True, nogil=True, inline="always")
def _factorise(M):
    """Replaces moments M (10,) by their lower Cholesky factor. A column whose pivot is below MIN_PIVOT becomes 0."""
    for j in range(4):
        d = M[j * (j + 1) // 2 + j]
        least = MIN_PIVOT * d
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
def _write_entry(c, q, number, m, sums, entries, total):
    """Writes the entry of plane q in bin c at `total`: `number` points with the sums (13,)."""
    bins, plane, count, root, incidence = entries
    bins[total], plane[total], count[total] = c, q, number
    for k in range(N_MOMENTS):
        root[total, k] = sums[k]
    _factorise(root[total])
    for k in range(3):
        incidence[total, 1 + k] = sums[N_MOMENTS + k]
    incidence[total, 0] = -(sums[10] * m[1] + sums[11] * m[2] + sums[12] * m[3])


@njit(cache=True, nogil=True, inline="always")
def _bin_scan(i, scans, motion, poses, per_bin, planes, weights, sorted_points, entries, total):
    """Writes the entries of scan i from `total` on, in the order of bins and planes. Returns the new total."""
    ends, points = sorted_points
    first, m, sums = scans.step_start[i], np.empty(4), np.empty(N_SUMS)
    for c in range(first // per_bin, scans.step_start[i + 1] // per_bin):
        for q in range(len(planes)):
            number = 0
            for b in range(c * per_bin, (c + 1) * per_bin):
                key = (b - first) * len(planes) + q
                begin, end = ends[key - 1] if key else 0, ends[key]
                if begin == end or not poses.known[b]:
                    continue
                if number == 0:
                    _fill_distance_at(poses.R_world_bin[c], poses.p_world_bin[c], planes[q], m)
                    for k in range(N_SUMS):
                        sums[k] = 0.0
                R, p, rate, velocity = poses.R_bin_step[b], poses.p_bin_step[b], motion.rate[b], motion.velocity[b]
                _add_points(points, begin, end, R, p, rate, velocity, m, weights, sums)
                number += end - begin
            if number:
                _write_entry(c, q, number, m, sums, entries, total)
                total += 1
    return total


@njit(cache=True, nogil=True)
def bin_scans(scans, motion, poses, per_bin, planes, weights, per_s, entries):
    """Sums the points of all scans in bins of per_bin steps. Returns the number of entries.

    motion: `Sweep` at the steps; planes (P, 6): normal, point; per_s: steps per second. Fills `entries`: bin, plane,
    count, root and incidence of each entry, see `Moments`.
    """
    n_keys, n_points, total = 0, 0, 0
    for i in range(len(scans.start) - 1):
        n_keys = max(n_keys, (scans.step_start[i + 1] - scans.step_start[i]) * len(planes))
        n_points = max(n_points, scans.start[i + 1] - scans.start[i])
    ends, points = np.empty(n_keys, np.int64), np.empty((4, n_points), np.float32)
    for i in range(len(scans.start) - 1):
        scan_ends = ends[: (scans.step_start[i + 1] - scans.step_start[i]) * len(planes)]
        _sort_scan(i, scans, per_s, len(planes), scan_ends, points)
        # int: the literal 0 has a type of its own, for which numba would compile everything again
        total = _bin_scan(i, scans, motion, poses, per_bin, planes, weights, (scan_ends, points), entries, int(total))
    return total


@njit(cache=True, nogil=True)
def move_to_world(scans, motion, step_s, points, origins):
    """Fills `points` (N, 3), all points in the world [m], and `origins` (N, 3), the position of the LiDAR at the
    instant of each point [m]. motion: `Sweep` at the middles of steps of step_s seconds."""
    for i in range(len(scans.start) - 1):
        for n in range(scans.start[i], scans.start[i + 1]):
            offset = np.float64(scans.offset_s[n])
            k = int(np.floor(offset * (1.0 / step_s)))
            b, dt = scans.step_start[i] + k - scans.first_step[i], offset - (k + 0.5) * step_s
            x, v, w = scans.xyz[n], motion.velocity[b], motion.rate[b]
            for a in range(3):
                points[n, a] = origins[n, a] = motion.position[b, a]
            for c in range(3):
                d, e = (c + 1) % 3, (c + 2) % 3
                turned = x[c] + dt * (w[d] * x[e] - w[e] * x[d])
                for a in range(3):
                    points[n, a] += motion.rotation[b, a, c] * (turned + dt * v[c])
                    origins[n, a] += motion.rotation[b, a, c] * dt * v[c]
