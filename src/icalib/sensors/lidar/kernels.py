"""Propagated gyroscope noise between a keyframe and the bins of a LiDAR, eliminated from the normal equations.

IMU readings propagate the pose of a keyframe to a bin. Their noise makes the rotation error of the bin a random walk
that starts at the keyframe. All bins on one side of a keyframe share one unknown x (3,) ~ N(0, I). Bin i is rotated by
noise_angle[i] x, where noise_angle is the standard deviation of the walk at the bin. The chi^2 gets the prior term
|x|^2, and x is eliminated by its Schur complement. With J the Jacobian by x, M = J^T J and u = J^T (J_all, r), summed
over the bins, u^T (I + M)^-1 u is subtracted from the normal equations. J is evaluated at the state from which a pass
starts. A Jacobian at the current state would bias the estimate to states where the noise absorbs more.

The rotation error of an industrial IMU over 12 ms is smaller than the rotation uncertainty from points of a spinning
LiDAR. With ten times that IMU noise both are equal: without this model rotations are off by 1.6 standard deviations.

Compiled kernels of the LiDAR factor: from moments of bins to the normal equations of a piece of the trajectory.

An entry is one plane in one bin. It has four whitened residuals L^T m. L L^T is the matrix of moments of its points,
and m . (1, x) is the distance of a point x from the plane. The sum of squares of the four residuals, and the products
of their derivatives, equal those of all points of the entry.

Errors delta of elevations, offsets and azimuths of rings move points by s . delta off the plane, which is not linear in
(1, x). With D = L^-1 sum w (1, x) s^T and sums over points and their weights w, the chi^2 of an entry becomes
|L^T m + D delta|^2 + delta^T (sum w s s^T - D^T D) delta. The second part are residuals that no pose or plane changes.
Rings share no point. Such errors are those since the start of a pass.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.small import cholesky
from icalib.motion.sensor_pose import chain_width, fill_chain, fill_imu_pose
from icalib.optim.rows import add_gram, add_product
from icalib.optim.state import KEYFRAME_DIM
from icalib.sensors.lidar.spec import N_RINGS

POSE_DIM, PLANE_DIM, RANGE_DIM = 6, 3, 2  # parameters of a pose, of a plane, and of ranges: their offset and scale


class NoiseSums(NamedTuple):
    """Products of Jacobians by the unknown rotation x, summed over the bins on one side of a keyframe.

    information (3, 3): products of x with itself. by_pose (3, w + n + 1): products of x with the w columns of keyframes
    and calibration parameters that act through the pose, with the n of the LiDAR, and with the residual. by_plane
    (P, 3, 3): products of x with the columns of each plane; only those of the first n_planes (1,) numbers in `planes`
    (P,) are filled.
    """

    information: np.ndarray
    by_pose: np.ndarray
    by_plane: np.ndarray
    planes: np.ndarray
    n_planes: np.ndarray


@njit(cache=True, nogil=True, inline="always")
def empty_noise_sums(width, plane_columns):
    """`NoiseSums` of zero. width: number of columns that act through the pose; plane_columns (P, 3 + n): `Planes`."""
    n_planes = len(plane_columns)
    by_plane = np.zeros((n_planes, 3, PLANE_DIM))
    by_pose = np.zeros((3, width + plane_columns.shape[1] - PLANE_DIM + 1))
    return NoiseSums(np.zeros((3, 3)), by_pose, by_plane, np.zeros(n_planes, np.int64), np.zeros(1, np.int64))


@njit(cache=True, nogil=True, inline="always")
def add_entry_noise(J_rows_noise, J_incidence_noise, row, J_rows, gram, noise):
    """Adds one entry to the information, to the column of the residual, and to gram (3, 6), the products of x with the
    pose of the bin.

    J_rows_noise (3, 4), J_incidence_noise (3,): see `Bins`; row (4,): whitened residuals; J_rows (>= 6, 4): their
    derivatives, by the pose of the bin first.
    """
    last = noise.by_pose.shape[1] - 1
    for a in range(3):
        noise.by_pose[a, last] += J_incidence_noise[a]
        for c in range(4):
            d = J_rows_noise[a, c]
            noise.by_pose[a, last] += d * row[c]
            for b in range(3):
                noise.information[a, b] += d * J_rows_noise[b, c]
            for j in range(POSE_DIM):
                gram[a, j] += d * J_rows[j, c]


@njit(cache=True, nogil=True, inline="always")
def add_pose_noise(gram, J_pose, noise):
    """Adds the products gram (3, 6) of a bin by the chain rule. J_pose (6, w): derivative of the pose of the bin by
    keyframes and calibration columns."""
    for a in range(3):
        for j in range(POSE_DIM):
            for i in range(J_pose.shape[1]):
                noise.by_pose[a, i] += gram[a, j] * J_pose[j, i]


@njit(cache=True, nogil=True, inline="always")
def add_plane_noise(J_rows_noise, J_rows, q, noise):
    """Adds the products of x with plane q and the parameters of the LiDAR in one bin. J_rows (10 + n, 4): derivatives,
    see `_BinWork`."""
    known = False
    for i in range(noise.n_planes[0]):
        known = known or noise.planes[i] == q
    if not known:
        noise.planes[noise.n_planes[0]] = q
        noise.n_planes[0] += 1
    n = len(J_rows) - OFFSET
    first = noise.by_pose.shape[1] - n - 1
    for a in range(3):
        for c in range(4):
            for t in range(n):
                noise.by_pose[a, first + t] += J_rows_noise[a, c] * J_rows[OFFSET + t, c]
            for t in range(PLANE_DIM):
                noise.by_plane[q, a, t] += J_rows_noise[a, c] * J_rows[PLANE + t, c]


@njit(cache=True, nogil=True, inline="always")
def noise_columns(noise, columns, plane_columns):
    """(m,) calibration columns of the sums: `columns` (c,), which act through the pose, then those of the LiDAR and of
    the planes seen, from plane_columns (P, 3 + n)."""
    n_lidar = plane_columns.shape[1] - PLANE_DIM
    n_c, n = len(columns) + n_lidar, noise.n_planes[0]
    out = np.empty(n_c + PLANE_DIM * n, np.int64)
    for j in range(len(columns)):  # in loops: copies of arrays take seconds to compile
        out[j] = columns[j]
    for t in range(n_lidar):
        out[len(columns) + t] = plane_columns[0, PLANE_DIM + t]
    for i in range(n):
        for t in range(PLANE_DIM):
            out[n_c + PLANE_DIM * i + t] = plane_columns[noise.planes[i], t]
    return out


@njit(cache=True, nogil=True, inline="always")
def eliminated_noise(noise):
    """V (3, w + 3 n + 1) such that V^T V is the Schur complement term of x, which the normal equations lose.

    Columns: keyframes, calibration parameters in the order of `noise_columns` (n planes seen), residual. Resets the
    sums.
    """
    n, width, L = noise.n_planes[0], noise.by_pose.shape[1] - 1, noise.information
    last = width + PLANE_DIM * n
    V = np.empty((3, last + 1))
    for a in range(3):
        for j in range(width):
            V[a, j] = noise.by_pose[a, j]
        V[a, last] = noise.by_pose[a, width]
        for i in range(n):
            for t in range(PLANE_DIM):
                V[a, width + PLANE_DIM * i + t] = noise.by_plane[noise.planes[i], a, t]
        L[a, a] += 1.0
    cholesky(L)
    for a in range(3):
        for j in range(last + 1):
            for b in range(a):
                V[a, j] -= L[a, b] * V[b, j]
            V[a, j] /= L[a, a]
    for i in range(n):
        noise.by_plane[noise.planes[i]] = 0.0
    noise.information[:], noise.by_pose[:] = 0.0, 0.0
    noise.n_planes[0] = 0
    return V


N_WHITENED = 4  # residuals of an entry
# Rows of the arrays of an entry, after the derivatives by the pose: the residual itself, then derivatives by the plane,
# the offset and scale of ranges, and the rings.
DISTANCE = POSE_DIM
PLANE = DISTANCE + 1
OFFSET = PLANE + PLANE_DIM
SCALE = OFFSET + 1
RINGS = SCALE + 1


class Bins(NamedTuple):
    """n bins with E entries. keyframe (n,): keyframe from which the pose of each is propagated. noise_angle (n,):
    standard deviation [rad] of the rotation error about each axis from propagated gyroscope noise, negative before the
    keyframe.

    Entries of bin i are start[i]:start[i + 1]; plane, root, incidence, rings: see `Moments`. J_rows_noise (E, 3, 4) and
    J_incidence_noise (E, 3): derivatives of the whitened residuals, and of the incidence term, by the unknown rotation
    x, as propagated from the keyframe.
    """

    keyframe: np.ndarray
    noise_angle: np.ndarray
    start: np.ndarray
    plane: np.ndarray
    root: np.ndarray
    incidence: np.ndarray
    rings: np.ndarray
    J_rows_noise: np.ndarray
    J_incidence_noise: np.ndarray


@njit(cache=True, nogil=True)
def _fill_distance(R_lw, p_wl, q, planes, m):
    """Fills m (4,), such that m . (1, x) is the distance [m] of point x, in the LiDAR's frame, from plane q."""
    m[0] = 0.0
    for a in range(3):
        m[0] += planes.normal[q, a] * (p_wl[a] - planes.point[q, a])
        m[1 + a] = 0.0
        for b in range(3):
            m[1 + a] += R_lw[a, b] * planes.normal[q, b]


@njit(cache=True, nogil=True, inline="always")
def _shorten(row, root, offset, derivative):
    """Makes coefficients `row` (4,) of (1, x) those of (1, y), y = x - offset x / |x|, linear in x about the mean of
    the points with moments `root`. Fills derivative (4,), theirs by the offset."""
    r = np.sqrt(root[1] ** 2 + root[3] ** 2 + root[6] ** 2)
    u0, u1, u2, per_m = root[1] / r, root[3] / r, root[6] / r, root[0] / r
    along = u0 * row[1] + u1 * row[2] + u2 * row[3]
    derivative[0] = -along
    derivative[1], derivative[2] = per_m * (along * u0 - row[1]), per_m * (along * u1 - row[2])
    derivative[3] = per_m * (along * u2 - row[3])
    for c in range(N_WHITENED):
        row[c] += offset * derivative[c]


@njit(cache=True, nogil=True, inline="always")
def _correct_ranges(row, root, planes, derivative):
    """Applies offset and scale of ranges to coefficients `row` (4,) of (1, x). Lengths are those that the LiDAR
    measures: in true lengths, a larger scale would make the noise smaller. If the offset is free, fills derivative
    (4,), that of the coefficients by it."""
    row[0] *= 1.0 + planes.range_scale
    if planes.columns[0, PLANE_DIM] >= 0:
        _shorten(row, root, planes.range_offset, derivative)
        for c in range(N_WHITENED):
            derivative[c] *= planes.range_unit


@njit(cache=True, nogil=True)
def _fill_jacobian(R_lw, p_wl, q, planes, m, root, J_distance):
    """Fills J_distance (12, 4): coefficients of (1, x) in the derivatives of the distance by pose (6 rows), in the
    distance, and in its derivatives by plane (3 rows), offset and scale of ranges. root (10,): of the moments of the
    points.

    With a = R^T n the derivatives by the pose are (x cross a; a), because a rotation t of the LiDAR moves x by
    t cross x, and a . (t cross x) = t . (x cross a).
    """
    A = J_distance
    A[:] = 0.0
    A[0, 2], A[0, 3] = m[3], -m[2]
    A[1, 3], A[1, 1] = m[1], -m[3]
    A[2, 1], A[2, 2] = m[2], -m[1]
    for a in range(3):
        A[3 + a, 0] = m[1 + a]
    for t in range(2):
        for a in range(3):
            A[PLANE + t, 0] += planes.tangents[q, t, a] * (p_wl[a] - planes.point[q, a])
            for b in range(3):
                A[PLANE + t, 1 + a] += R_lw[a, b] * planes.tangents[q, t, b]
    A[PLANE + 2, 0] = -1.0
    for c in range(N_WHITENED):
        A[DISTANCE, c] = m[c]
    for i in range(OFFSET):  # of the distance the derivative by the offset is kept
        _correct_ranges(A[i], root, planes, A[OFFSET if i == DISTANCE else SCALE])
    A[SCALE] = 0.0
    A[SCALE, 0] = planes.range_unit * m[0]


@njit(cache=True, nogil=True)
def _times_root(A, root, B, n):
    """Fills B[:n] = A[:n] L, with L (4, 4) the lower triangular matrix `root` (10,), row by row."""
    for i in range(n):
        B[i, 0] = A[i, 0] * root[0] + A[i, 1] * root[1] + A[i, 2] * root[3] + A[i, 3] * root[6]
        B[i, 1] = A[i, 1] * root[2] + A[i, 2] * root[4] + A[i, 3] * root[7]
        B[i, 2] = A[i, 2] * root[5] + A[i, 3] * root[8]
        B[i, 3] = A[i, 3] * root[9]


@njit(cache=True, nogil=True, inline="always")
def _add_pose_gram(J_rows, J_distance, incidence, gram):
    """Adds an entry to gram (6, 7): products of its derivatives by the pose with one another and with the residual.
    The gradient of the incidence term is added to the last column; its second derivative is neglected."""
    for i in range(POSE_DIM):
        for j in range(POSE_DIM + 1):  # the last is DISTANCE
            gram[i, j] += (
                J_rows[i, 0] * J_rows[j, 0]
                + J_rows[i, 1] * J_rows[j, 1]
                + J_rows[i, 2] * J_rows[j, 2]
                + J_rows[i, 3] * J_rows[j, 3]
            )
        gram[i, POSE_DIM] += (
            J_distance[i, 1] * incidence[1] + J_distance[i, 2] * incidence[2] + J_distance[i, 3] * incidence[3]
        )


@njit(cache=True, nogil=True, inline="always")
def _add_chain(k, first, last, J_pose, columns, plane_columns, work, sums):
    """Adds to the sums of keyframe k the products work.gram_columns of the pose of a bin with the columns first:last of
    `plane_columns` (5 + K,), by the chain rule. J_pose (6, w): derivative of this pose by keyframes and calibration
    columns (c,)."""
    V, n_chain = work.V, J_pose.shape[1] - len(columns)
    for t in range(first, last):
        for j in range(J_pose.shape[1]):
            V[t, j] = 0.0
        for i in range(POSE_DIM):
            for j in range(J_pose.shape[1]):
                V[t, j] += work.gram_columns[i, t] * J_pose[i, j]
    for h in range(n_chain // KEYFRAME_DIM):
        for r in range(KEYFRAME_DIM):
            for t in range(first, last):
                if plane_columns[t] >= 0:
                    sums.side[k + h, r, plane_columns[t]] += V[t, KEYFRAME_DIM * h + r]
    for j in range(len(columns)):
        if columns[j] >= 0:
            for t in range(first, last):
                if plane_columns[t] >= 0:
                    sums.calib[columns[j], plane_columns[t]] += V[t, n_chain + j]
                    sums.calib[plane_columns[t], columns[j]] += V[t, n_chain + j]


@njit(cache=True, nogil=True, inline="always")
def _add_columns(J_rows, rings, n, plane_columns, gram_columns, sums):
    """Adds to the sums the products of an entry by the first n of the columns `plane_columns` (5 + K,) of its plane, of
    the ranges and of the errors of rings (K, 8), see `Moments`, of which some may be fixed. Fills the first three of
    gram_columns (6, 5 + K), its products by the pose, and adds to the others."""
    B, n_b, n_others = J_rows, sums.calib.shape[0] - 1, PLANE_DIM + RANGE_DIM
    for i in range(POSE_DIM):
        for t in range(n):
            b = B[PLANE + t]
            s = B[i, 0] * b[0] + B[i, 1] * b[1] + B[i, 2] * b[2] + B[i, 3] * b[3]
            gram_columns[i, t] = s if t < PLANE_DIM else gram_columns[i, t] + s
    for t in range(n):
        b, column = B[PLANE + t], plane_columns[t]
        for c in range(-1, min(t + 1, n_others)):  # -1 is DISTANCE
            d, other = B[PLANE + c], n_b if c < 0 else plane_columns[c]
            if column >= 0 and other >= 0:
                s = b[0] * d[0] + b[1] * d[1] + b[2] * d[2] + b[3] * d[3]
                sums.calib[column, other] += s
                if c != t:
                    sums.calib[other, column] += s
        for f in range(len(rings) // N_RINGS if t >= n_others else 0):  # of all points, not only of the four rows
            other = plane_columns[n_others + f * N_RINGS + (t - n_others) % N_RINGS]
            if column >= 0 and other >= 0:
                sums.calib[column, other] += rings[t - n_others, 5 + f]


@njit(cache=True, nogil=True, inline="always")
def _add_plane_incidence(J_distance, incidence, by_ring, plane_columns, sums):
    """Adds to the sums the gradient of what the cost has beside the rows, by the plane, the ranges and the rings with
    columns `plane_columns` (5 + K,). by_ring (K,): that by the rings."""
    n_b, n = sums.calib.shape[0] - 1, PLANE_DIM + RANGE_DIM
    for t in range(len(plane_columns)):
        if t < n:
            J = J_distance[PLANE + t]
            s = J[1] * incidence[1] + J[2] * incidence[2] + J[3] * incidence[3]
        else:
            s = by_ring[t - n]
        if plane_columns[t] >= 0:
            sums.calib[plane_columns[t], n_b] += s
            sums.calib[n_b, plane_columns[t]] += s


@njit(cache=True, nogil=True, inline="always")
def _eliminate_noise(k, noise, n_chain, columns, plane_columns, sums):
    """Eliminates the unknown rotation of one side of keyframe k. Returns the decrease of the chi^2 by it."""
    noise_cols, V = noise_columns(noise, columns, plane_columns), eliminated_noise(noise)
    last = V.shape[1] - 1
    if len(sums.diagonal) > 0:
        add_product(k, n_chain, last, V, -V, noise_cols, sums)
    return V[0, last] ** 2 + V[1, last] ** 2 + V[2, last] ** 2


@njit(cache=True, nogil=True, inline="always")
def _is_last_of_side(i, bins):
    """Whether bin i is the last one on its side of its keyframe."""
    if i + 1 == len(bins.keyframe) or bins.keyframe[i + 1] != bins.keyframe[i]:
        return True
    return (bins.noise_angle[i + 1] < 0.0) != (bins.noise_angle[i] < 0.0)


class _BinWork(NamedTuple):
    """Workspace. J_pose (6, w), J_imu_pose (6, 6): see `fill_chain`; m (4,): see `_fill_distance`.

    J_distance (12, 4), J_rows (12 + K, 4): derivatives of an entry, and these times its root, then those by K errors of
    rings.
    gram (6, 7): products of the derivatives of a bin by its pose with themselves and with the residual. gram_noise (3,
    6): their products with the derivatives by the unknown rotation. F, V: see `add_gram` and `_add_chain`. by_ring
    (K,): see `_add_rings`.
    """

    J_pose: np.ndarray
    J_imu_pose: np.ndarray
    m: np.ndarray
    J_distance: np.ndarray
    J_rows: np.ndarray
    gram: np.ndarray
    gram_noise: np.ndarray
    F: np.ndarray
    V: np.ndarray
    gram_columns: np.ndarray
    by_ring: np.ndarray


@njit(cache=True, nogil=True)
def _work_space(at, n_columns, n_rings):
    """The workspace for poses `at` with n_columns calibration columns and n_rings errors of rings."""
    width = chain_width(at) + n_columns
    return _BinWork(
        np.empty((POSE_DIM, width)),
        np.empty((POSE_DIM, POSE_DIM)),
        np.empty(N_WHITENED),
        np.empty((RINGS, N_WHITENED)),
        np.empty((RINGS + n_rings, N_WHITENED)),
        np.empty((POSE_DIM, POSE_DIM + 1)),
        np.empty((3, POSE_DIM)),
        np.empty((POSE_DIM, width + 1)),
        np.empty((PLANE_DIM + RANGE_DIM + n_rings, width)),
        np.empty((POSE_DIM, PLANE_DIM + RANGE_DIM + n_rings)),
        np.empty(n_rings),
    )


@njit(cache=True, nogil=True, inline="always")
def _add_rings(rings, change, row, by_ring):
    """Adds changes (K,) of the errors of rings since the start of the pass to `row` (4,). Fills by_ring (K,), the
    gradient of what the cost of the entry has beside its rows, and returns this. rings (K, 8): see `Moments`."""
    cost, moved = 0.0, np.zeros(N_WHITENED)
    for k in range(len(rings)):
        for c in range(N_WHITENED):
            moved[c] += rings[k, c] * change[k]
    for k in range(len(rings)):
        by_ring[k] = 0.0
        for f in range(len(rings) // N_RINGS):
            by_ring[k] += rings[k, 5 + f] * change[f * N_RINGS + k % N_RINGS]
        for c in range(N_WHITENED):
            by_ring[k] -= rings[k, c] * moved[c]
        cost += (0.5 * by_ring[k] + rings[k, 4]) * change[k]
        by_ring[k] += rings[k, 4]
    for c in range(N_WHITENED):
        row[c] += moved[c]
    return cost


@njit(cache=True, nogil=True, inline="always")
def _fill_residuals(e, R_lw, p_wl, bins, planes, work, rows):
    """Fills row e of `rows` (E, 4), the whitened residuals of entry e with the LiDAR at R_lw, p_wl. Returns half their
    chi^2 plus the incidence term."""
    m, incidence = work.m, bins.incidence
    _fill_distance(R_lw, p_wl, bins.plane[e], planes, m)
    for c in range(N_WHITENED):
        work.J_distance[0, c] = m[c]
    _correct_ranges(work.J_distance[0], bins.root[e], planes, work.J_distance[1])
    _times_root(work.J_distance, bins.root[e], rows[e : e + 1], 1)
    cost = incidence[e, 0]
    if bins.rings.shape[1]:
        cost += _add_rings(bins.rings[e], planes.rings, rows[e], work.by_ring)
    for c in range(N_WHITENED):
        cost += 0.5 * rows[e, c] ** 2
        cost += incidence[e, c] * work.J_distance[0, c] if c else 0.0
    return cost


@njit(cache=True, nogil=True)
def linearise_noise(bins, at, columns, planes):
    """Adds the derivatives by the unknown rotation x to J_rows_noise and J_incidence_noise of the bins, which must be
    0.

    at: poses of the LiDAR at the bins; columns (c,): their calibration columns.
    """
    work = _work_space(at, len(columns), 0)
    A, B, J_imu_pose = work.J_distance, work.J_rows, work.J_imu_pose
    for i in range(len(bins.keyframe)):
        R_lw, p_wl = at.R_sensor_world[i], at.p_world_sensor[i]
        fill_imu_pose(i, at, J_imu_pose)
        for e in range(bins.start[i], bins.start[i + 1]):
            _fill_distance(R_lw, p_wl, bins.plane[e], planes, work.m)
            _fill_jacobian(R_lw, p_wl, bins.plane[e], planes, work.m, bins.root[e], A)
            _times_root(A, bins.root[e], B, POSE_DIM)
            for a in range(3):
                for j in range(POSE_DIM):
                    w = bins.noise_angle[i] * J_imu_pose[j, a]
                    for c in range(N_WHITENED):
                        bins.J_rows_noise[e, a, c] += w * B[j, c]
                        bins.J_incidence_noise[e, a] += w * A[j, c] * bins.incidence[e, c] if c else 0.0


@njit(cache=True, nogil=True, inline="always")
def _add_entry(e, k, R_lw, p_wl, bins, planes, columns, n, work, sums, rows, noise, has_noise):
    """Adds entry e, of a bin of keyframe k, to the sums unless these are empty, with the first n columns of its plane
    and of the LiDAR. Returns its part of the cost."""
    q, wanted = bins.plane[e], len(sums.diagonal) > 0
    plane_columns, A, B = planes.columns[q], work.J_distance, work.J_rows
    cost = _fill_residuals(e, R_lw, p_wl, bins, planes, work, rows)
    if wanted:
        _fill_jacobian(R_lw, p_wl, q, planes, work.m, bins.root[e], A)
        _times_root(A, bins.root[e], B, RINGS)
        for c in range(N_WHITENED):
            B[DISTANCE, c] = rows[e, c]
            for t in range(bins.rings.shape[1]):
                B[RINGS + t, c] = bins.rings[e, t, c]
        _add_pose_gram(B, A, bins.incidence[e], work.gram)
    if has_noise:
        add_entry_noise(bins.J_rows_noise[e], bins.J_incidence_noise[e], rows[e], B, work.gram_noise, noise)
    if wanted and (n > PLANE_DIM or plane_columns[0] >= 0):
        _add_columns(B, bins.rings[e], n, plane_columns, work.gram_columns, sums)
        _add_chain(k, 0, PLANE_DIM, work.J_pose, columns, plane_columns, work, sums)
        _add_plane_incidence(A, bins.incidence[e], work.by_ring, plane_columns, sums)
        if has_noise:
            add_plane_noise(bins.J_rows_noise[e], B, q, noise)
    return cost


@njit(cache=True, nogil=True)
def accumulate(bins, at, columns, planes, sums, rows):
    """Fills the whitened residuals `rows` (E, 4) of all bins, and adds their normal equations to `sums` unless these
    are empty.

    at: poses of the LiDAR at the bins; columns (c,): their calibration columns. Returns half the chi^2, minus the part
    that propagated noise absorbs, plus the incidence term.
    """
    wanted, work, cost = len(sums.diagonal) > 0, _work_space(at, len(columns), bins.rings.shape[1]), 0.0
    J_pose, n_chain = work.J_pose, chain_width(at)
    noise = empty_noise_sums(J_pose.shape[1], planes.columns)
    is_ideal = bins.rings.shape[1] == 0 and max(planes.columns[0, PLANE_DIM], planes.columns[0, PLANE_DIM + 1]) < 0
    n = PLANE_DIM if is_ideal else planes.columns.shape[1]
    for i in range(len(bins.keyframe)):
        k, has_noise = bins.keyframe[i] - sums.first, bins.noise_angle[i] != 0.0
        R_lw, p_wl = at.R_sensor_world[i], at.p_world_sensor[i]
        if wanted:
            fill_chain(i, at, work.J_imu_pose, J_pose)
        work.J_rows[:], work.gram[:], work.gram_noise[:], work.gram_columns[:] = 0.0, 0.0, 0.0, 0.0
        for e in range(bins.start[i], bins.start[i + 1]):
            cost += _add_entry(e, k, R_lw, p_wl, bins, planes, columns, n, work, sums, rows, noise, has_noise)
        if wanted:
            _add_chain(k, PLANE_DIM, n, J_pose, columns, planes.columns[0], work, sums)
            add_gram(k, n_chain, work.gram, J_pose, columns, work.F, sums)
        if wanted and has_noise:
            add_pose_noise(work.gram_noise, J_pose, noise)
        if has_noise and _is_last_of_side(i, bins):
            cost -= 0.5 * _eliminate_noise(k, noise, n_chain, columns, planes.columns, sums)
    return cost
