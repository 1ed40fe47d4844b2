"""Compiled sums of the LiDAR factor: from moments of bins to the normal equations of a piece.

A bin sees a plane as four whitened residuals L^T m with L L^T the moments of its points and m . (1, x) the distance of
a point x. Sums of their squares and derivatives are those of the points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.motion.sensor_pose import chain_width, fill_chain, fill_imu_pose
from icalib.optim.rows import add_gram, add_product
from icalib.optim.state import KEYFRAME_DIM
from icalib.sensors.lidar.propagation_noise import (
    PLANE,
    POSE,
    add_entry,
    add_plane,
    add_pose,
    columns_of,
    no_walk,
    taken_off,
)

ROWS = 4  # whitened residuals of a plane in a bin
RESIDUAL = POSE + PLANE  # the last column of an entry's Jacobian


class Bins(NamedTuple):
    """Bins of a piece: keyframe (n,); walked (n,): by what angle the gyroscope's noise turns the IMU about each axis on
    the way from the keyframe, one standard deviation [rad], negative before it; entries of bin i are start[i]:start[i +
    1], with plane, root and slant as in `Moments`; turned (E, 3, 4), slope (E, 3): how their residuals, and what
    slanted beams add to half the chi^2, change with that turn."""

    keyframe: np.ndarray
    walked: np.ndarray
    start: np.ndarray
    plane: np.ndarray
    root: np.ndarray
    slant: np.ndarray
    turned: np.ndarray
    slope: np.ndarray


@njit(cache=True, nogil=True)
def _distances(R_lw, p_wl, q, planes, m):
    """m (4,) with m . (1, x) the distance of point x, in the LiDAR's frame, from plane q."""
    m[0] = 0.0
    for a in range(3):
        m[0] += planes.normal[q, a] * (p_wl[a] - planes.point[q, a])
        m[1 + a] = 0.0
        for b in range(3):
            m[1 + a] += R_lw[a, b] * planes.normal[q, b]


@njit(cache=True, nogil=True)
def _jacobian(R_lw, p_wl, q, planes, m, A):
    """A (10, 4): derivatives of the distance by pose (x cross a; a) and plane, and itself, as factors of (1, x).

    With a = R^T n: turning the LiDAR by t moves x by t cross x, and a . (t cross x) = t . (x cross a).
    """
    A[:] = 0.0
    A[0, 2], A[0, 3] = m[3], -m[2]
    A[1, 3], A[1, 1] = m[1], -m[3]
    A[2, 1], A[2, 2] = m[2], -m[1]
    for a in range(3):
        A[3 + a, 0] = m[1 + a]
    for t in range(2):
        for a in range(3):
            A[POSE + t, 0] += planes.tangents[q, t, a] * (p_wl[a] - planes.point[q, a])
            for b in range(3):
                A[POSE + t, 1 + a] += R_lw[a, b] * planes.tangents[q, t, b]
    A[POSE + 2, 0] = -1.0
    for c in range(ROWS):
        A[RESIDUAL, c] = m[c]


@njit(cache=True, nogil=True)
def _times_root(A, root, B):
    """B (n, 4) = A[:n] L with L the lower triangle `root` (10,), row by row."""
    for i in range(len(B)):
        B[i, 0] = A[i, 0] * root[0] + A[i, 1] * root[1] + A[i, 2] * root[3] + A[i, 3] * root[6]
        B[i, 1] = A[i, 1] * root[2] + A[i, 2] * root[4] + A[i, 3] * root[7]
        B[i, 2] = A[i, 2] * root[5] + A[i, 3] * root[8]
        B[i, 3] = A[i, 3] * root[9]


@njit(cache=True, nogil=True, inline="always")
def _add_to_pose(B, A, slant, G):
    """The pose part of one plane in one bin to G (6, 7), with the gradient of slant . (1, R^T n), which bends too
    little to count."""
    for i in range(POSE):
        for j in range(POSE + 1):
            c = j if j < POSE else RESIDUAL
            G[i, j] += B[i, 0] * B[c, 0] + B[i, 1] * B[c, 1] + B[i, 2] * B[c, 2] + B[i, 3] * B[c, 3]
        G[i, POSE] += A[i, 1] * slant[1] + A[i, 2] * slant[2] + A[i, 3] * slant[3]


@njit(cache=True, nogil=True, inline="always")
def _add_plane(k, B, T, columns, own, sums, V):
    """What the columns `own` of one plane in one bin share in, to the sums; V (3, w): work space."""
    n_b, n_chain = sums.calib.shape[0] - 1, T.shape[1] - len(columns)
    V[:] = 0.0
    for i in range(POSE):
        for t in range(PLANE):
            b = B[POSE + t]
            v = B[i, 0] * b[0] + B[i, 1] * b[1] + B[i, 2] * b[2] + B[i, 3] * b[3]
            for j in range(T.shape[1]):
                V[t, j] += v * T[i, j]
    for h in range(n_chain // KEYFRAME_DIM):
        for r in range(KEYFRAME_DIM):
            for t in range(PLANE):
                sums.side[k + h, r, own[t]] += V[t, KEYFRAME_DIM * h + r]
    for j in range(len(columns)):
        if columns[j] >= 0:
            for t in range(PLANE):
                sums.calib[columns[j], own[t]] += V[t, n_chain + j]
                sums.calib[own[t], columns[j]] += V[t, n_chain + j]
    for t in range(PLANE):
        b = B[POSE + t]
        for c in range(PLANE + 1):
            d, other = B[POSE + c], n_b if c == PLANE else own[c]
            s = b[0] * d[0] + b[1] * d[1] + b[2] * d[2] + b[3] * d[3]
            sums.calib[own[t], other] += s
            if c == PLANE:
                sums.calib[n_b, own[t]] += s


@njit(cache=True, nogil=True, inline="always")
def _add_slant(A, slant, own, sums):
    """The gradient of slant . (1, R^T n) by the plane, to the sums."""
    n_b = sums.calib.shape[0] - 1
    for t in range(PLANE):
        s = A[POSE + t, 1] * slant[1] + A[POSE + t, 2] * slant[2] + A[POSE + t, 3] * slant[3]
        sums.calib[own[t], n_b] += s
        sums.calib[n_b, own[t]] += s


@njit(cache=True, nogil=True, inline="always")
def _take_off(k, walk, n_chain, columns, of_plane, sums):
    """Ends a walk from keyframe k; returns what it takes off the chi^2."""
    own, V = columns_of(walk, columns, of_plane), taken_off(walk)
    last = V.shape[1] - 1
    if len(sums.diagonal) > 0:
        add_product(k, n_chain, last, V, -V, own, sums)
    return V[0, last] ** 2 + V[1, last] ** 2 + V[2, last] ** 2


@njit(cache=True, nogil=True, inline="always")
def _ends_here(i, bins):
    """Whether bin i is the last on its side of its keyframe."""
    if i + 1 == len(bins.keyframe) or bins.keyframe[i + 1] != bins.keyframe[i]:
        return True
    return (bins.walked[i + 1] < 0.0) != (bins.walked[i] < 0.0)


class _BinWork(NamedTuple):
    """Work space of `accumulate`. T, A_imu: see `fill_chain`; m: see `_distances`; A, B (10, 4): derivatives of an
    entry, and these times its root; G (6, 7), W (3, 6): products of a bin's derivatives by its pose with themselves and
    the residual, and with those by the turn that noise makes; F, V: room for sums."""

    T: np.ndarray
    A_imu: np.ndarray
    m: np.ndarray
    A: np.ndarray
    B: np.ndarray
    G: np.ndarray
    W: np.ndarray
    F: np.ndarray
    V: np.ndarray


@njit(cache=True, nogil=True)
def _work_space(at, n_columns):
    width = chain_width(at) + n_columns
    return _BinWork(
        np.empty((POSE, width)), np.empty((POSE, POSE)), np.empty(ROWS), np.empty((RESIDUAL + 1, ROWS)),
        np.empty((RESIDUAL + 1, ROWS)), np.empty((POSE, POSE + 1)), np.empty((3, POSE)), np.empty((POSE, width + 1)),
        np.empty((PLANE, width)),
    )  # fmt: skip


@njit(cache=True, nogil=True, inline="always")
def _see(e, R_lw, p_wl, bins, planes, work, rows):
    """Whitened residuals of entry e, the LiDAR at R_lw, p_wl. Returns half their chi^2 and what their variances add as
    beams turn."""
    _distances(R_lw, p_wl, bins.plane[e], planes, work.m)
    for c in range(ROWS):
        work.A[0, c] = work.m[c]
    _times_root(work.A, bins.root[e], rows[e : e + 1])
    cost = bins.slant[e, 0]
    for c in range(ROWS):
        cost += 0.5 * rows[e, c] ** 2
        cost += bins.slant[e, c] * work.m[c] if c else 0.0
    return cost


@njit(cache=True, nogil=True)
def turn_by_noise(bins, at, columns, planes):
    """Fills `turned` and `slope` of the bins, which are empty."""
    work = _work_space(at, len(columns))
    for i in range(len(bins.keyframe)):
        R_lw, p_wl = at.R_sensor_world[i], at.p_world_sensor[i]
        fill_imu_pose(i, at, work.A_imu)
        for e in range(bins.start[i], bins.start[i + 1]):
            _distances(R_lw, p_wl, bins.plane[e], planes, work.m)
            _jacobian(R_lw, p_wl, bins.plane[e], planes, work.m, work.A)
            _times_root(work.A, bins.root[e], work.B[:POSE])
            for a in range(3):
                for j in range(POSE):
                    w = bins.walked[i] * work.A_imu[j, a]
                    for c in range(ROWS):
                        bins.turned[e, a, c] += w * work.B[j, c]
                        bins.slope[e, a] += w * work.A[j, c] * bins.slant[e, c] if c else 0.0


@njit(cache=True, nogil=True)
def accumulate(bins, at, columns, planes, sums, rows):
    """Whitened residuals `rows` (E, 4) of all bins, and their normal equations where they are wanted. at: poses of the
    LiDAR at the bins; columns (c,): calibration columns of these.

    Returns half the chi^2, less what the gyroscope's noise explains, and what the variances add as beams turn.
    """
    wanted, work, cost = len(sums.diagonal) > 0, _work_space(at, len(columns)), 0.0
    T, A, B, G, W = work.T, work.A, work.B, work.G, work.W
    n_chain, walk = chain_width(at), no_walk(T.shape[1], len(planes.normal))
    for i in range(len(bins.keyframe)):
        k, walks = bins.keyframe[i] - sums.first, bins.walked[i] != 0.0
        R_lw, p_wl = at.R_sensor_world[i], at.p_world_sensor[i]
        if wanted:
            fill_chain(i, at, work.A_imu, T)
        B[:], G[:], W[:] = 0.0, 0.0, 0.0
        for e in range(bins.start[i], bins.start[i + 1]):
            q = bins.plane[e]
            cost += _see(e, R_lw, p_wl, bins, planes, work, rows)
            if wanted:
                _jacobian(R_lw, p_wl, q, planes, work.m, A)
                _times_root(A, bins.root[e], B)
                _add_to_pose(B, A, bins.slant[e], G)
            if walks:
                add_entry(bins.turned[e], bins.slope[e], rows[e], B, W, walk)
            if wanted and planes.columns[q, 0] >= 0:
                _add_plane(k, B, T, columns, planes.columns[q], sums, work.V)
                _add_slant(A, bins.slant[e], planes.columns[q], sums)
                if walks:
                    add_plane(bins.turned[e], B, q, walk)
        if wanted:
            add_gram(k, n_chain, G, T, columns, work.F, sums)
        if wanted and walks:
            add_pose(W, T, walk)
        if walks and _ends_here(i, bins):
            cost -= 0.5 * _take_off(k, walk, n_chain, columns, planes.columns, sums)
    return cost
