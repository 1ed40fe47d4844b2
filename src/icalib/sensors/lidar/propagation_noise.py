"""Propagated gyroscope noise between a keyframe and the bins of a LiDAR, eliminated from the normal equations.

IMU readings propagate the pose of a keyframe to a bin. Their noise makes the rotation error of the bin a random walk
that starts at the keyframe. All bins on one side of a keyframe share one unknown x (3,) ~ N(0, I). Bin i is rotated by
noise_angle[i] x, where noise_angle is the standard deviation of the walk at the bin. The chi^2 gets the prior term
|x|^2, and x is eliminated by its Schur complement. With J the Jacobian by x, M = J^T J and u = J^T (J_all, r), summed
over the bins, u^T (I + M)^-1 u is subtracted from the normal equations. J is evaluated at the state from which a pass
starts. A Jacobian at the current state would bias the estimate to states where the noise absorbs more.

The rotation error of an industrial IMU over 12 ms is smaller than the rotation uncertainty from points of a spinning
LiDAR. With ten times that IMU noise both are equal: without this model rotations are off by 1.6 standard deviations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.small import cholesky

POSE_DIM, PLANE_DIM = 6, 3  # parameters of a pose and of a plane


class NoiseSums(NamedTuple):
    """Products of Jacobians by the unknown rotation x, summed over the bins on one side of a keyframe.

    information (3, 3): products of x with itself. by_pose (3, w + 1): products of x with the w columns of keyframes and
    calibration parameters that act through the pose, and with the residual. by_plane (P, 3, 3): products of x with the
    columns of each plane; only those of the first n_planes (1,) numbers in `planes` (P,) are
    filled.
    """

    information: np.ndarray
    by_pose: np.ndarray
    by_plane: np.ndarray
    planes: np.ndarray
    n_planes: np.ndarray


@njit(cache=True, nogil=True, inline="always")
def empty_noise_sums(width, n_planes):
    """`NoiseSums` of zero. width: number of columns that act through the pose; n_planes: of planes."""
    by_plane = np.zeros((n_planes, 3, PLANE_DIM))
    return NoiseSums(
        np.zeros((3, 3)), np.zeros((3, width + 1)), by_plane, np.zeros(n_planes, np.int64), np.zeros(1, np.int64)
    )


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
    """Adds the products of x with plane q in one bin. J_rows (10, 4): derivatives by the pose, then by the plane."""
    known = False
    for i in range(noise.n_planes[0]):
        known = known or noise.planes[i] == q
    if not known:
        noise.planes[noise.n_planes[0]] = q
        noise.n_planes[0] += 1
    for a in range(3):
        for t in range(PLANE_DIM):
            for c in range(4):
                noise.by_plane[q, a, t] += J_rows_noise[a, c] * J_rows[POSE_DIM + t, c]


@njit(cache=True, nogil=True, inline="always")
def noise_columns(noise, columns, plane_columns):
    """(m,) calibration columns of the sums: `columns` (c,), which act through the pose, then those of the planes seen,
    from plane_columns (P, 3)."""
    n_c, n = len(columns), noise.n_planes[0]
    out = np.empty(n_c + PLANE_DIM * n, np.int64)
    for j in range(n_c):  # in loops: copies of arrays take seconds to compile
        out[j] = columns[j]
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
