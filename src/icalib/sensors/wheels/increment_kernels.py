"""Rows of the increments of wheels: residuals and Jacobians between two instants.

An increment is compared with (X, T), a displacement and a turn in wheel axes, made of (Y, Theta) in those of the IMU:

    X = R_imu_wheel^T Y,  T = R_imu_wheel^T Theta,  Theta = Log(R(s_0)^T R(s_1))

A row of the model is g_X X + g_T T; the derivatives of (Y, Theta) by what they hang on are common to all rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.small import tmul3
from icalib.motion.sensor_pose import N_MOUNTED, OFFSET
from icalib.optim.rows import KEYFRAME_PAIR_DIM
from icalib.optim.state import KEYFRAME_DIM
from icalib.sensors.wheels.drive_rows import N_DRIVE


class Wheels(NamedTuple):
    """R_imu_wheel (3, 3), p_imu_wheel (3,) m, drive (3,): its own parameters, of a pair left and right radius and
    baseline [m]; see `drive_rows`."""

    R: np.ndarray
    p: np.ndarray
    drive: np.ndarray


class Track(NamedTuple):
    """Of `Poses` what the kernels need, at m instants, and the keyframe that each hangs on."""

    keyframe: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray
    J_keyframe: np.ndarray
    J_imu: np.ndarray


@njit(cache=True, nogil=True)
def _cross(a, b):
    return np.array((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


@njit(cache=True, nogil=True)
def _add(R, x, scale, sign, out):
    """out (3,) += scale R x, or R^T x where sign is negative."""
    for i in range(3):
        for j in range(3):
            out[i] += scale * (R[i, j] if sign > 0 else R[j, i]) * x[j]


@njit(cache=True, nogil=True)
def _turn(a, b, track, M0, M1, Mc, wanted):
    """Theta (3,) between instants a and b; its derivatives, where `wanted`, by their keyframes into rows 3: of M0, M1
    (6, 15), by time and the IMU intrinsics into those of Mc (6, 1 + 24 or 0)."""
    theta = so3.log(tmul3(track.rotation[a], track.rotation[b]))
    if not wanted:
        return theta
    before, after = so3.left_jacobian_inverse(theta), so3.right_jacobian_inverse(theta)
    for i in range(3):
        for j in range(3):
            Mc[3 + i, 0] += after[i, j] * track.rate[b, j] - before[i, j] * track.rate[a, j]
            for c in range(KEYFRAME_DIM):
                M0[3 + i, c] -= before[i, j] * track.J_keyframe[a, j, c]
                M1[3 + i, c] += after[i, j] * track.J_keyframe[b, j, c]
            for c in range(track.J_imu.shape[2]):
                Mc[3 + i, 1 + c] += after[i, j] * track.J_imu[b, j, c] - before[i, j] * track.J_imu[a, j, c]
    return theta


@njit(cache=True, nogil=True)
def _add_travel(j, w, track, moving, D, M, Mc, wanted):
    """Adds w R^T v of instant j to D (3,), its derivatives to the first rows of M (6, 15) and Mc."""
    R, u = track.rotation[j], np.zeros(3)
    _add(R, track.velocity[j], 1.0, -1, u)
    for i in range(3):
        D[i] += w * u[i]
    if not wanted:
        return
    spin = _cross(u, track.rate[j])  # hat(u) rate: how u moves as the body turns
    pull = np.zeros(3)
    _add(R, moving.acceleration[j], 1.0, -1, pull)
    U = so3.hat(u)
    for i in range(3):
        Mc[i, 0] += w * (spin[i] + pull[i])
        for k in range(3):
            for c in range(KEYFRAME_DIM):
                M[i, c] += w * (U[i, k] * track.J_keyframe[j, k, c] + R[k, i] * moving.J_keyframe[j, k, c])
            for c in range(track.J_imu.shape[2]):
                Mc[i, 1 + c] += w * (U[i, k] * track.J_imu[j, k, c] + R[k, i] * moving.J_imu[j, k, c])


@njit(cache=True, nogil=True)
def _fill_row(i, q, gX, gT, aY, aT, X, T, M0, M1, Mc, rows):
    """Derivatives of row q of interval i, g_X X + g_T T = a_Y Y + a_T Theta: keyframes, rotation, time, IMU
    intrinsics."""
    # R <- R Exp(d) turns X and T by -d: d X = X x d.
    x, t = _cross(gX, X), _cross(gT, T)
    for c in range(3):
        rows.J[i, q, KEYFRAME_PAIR_DIM + c] = x[c] + t[c]
    for k in range(3):
        for c in range(KEYFRAME_DIM):
            rows.J[i, q, c] += aY[k] * M0[k, c] + aT[k] * M0[3 + k, c]
            rows.J[i, q, KEYFRAME_DIM + c] += aY[k] * M1[k, c] + aT[k] * M1[3 + k, c]
        rows.J[i, q, KEYFRAME_PAIR_DIM + OFFSET] += aY[k] * Mc[k, 0] + aT[k] * Mc[3 + k, 0]
        for c in range(Mc.shape[1] - 1):
            rows.J[i, q, KEYFRAME_PAIR_DIM + N_MOUNTED + c] += aY[k] * Mc[k, 1 + c] + aT[k] * Mc[3 + k, 1 + c]


@njit(cache=True, nogil=True)
def _in_imu_axes(wheels, gX, gT, aY, aT):
    """Of a row g_X, g_T (3,) in wheel axes: a_Y, a_T (3,) in those of the IMU. Y = D + Theta x p, so that
    a_T = R g_T + p x a_Y."""
    aY[:], aT[:] = 0.0, 0.0
    _add(wheels.R, gX, 1.0, 1, aY)
    _add(wheels.R, gT, 1.0, 1, aT)
    aT += _cross(wheels.p, aY)


@njit(cache=True, nogil=True)
def _by_drive(i, q, by_X, by_T, X, T, rows):
    """Derivatives of row q of interval i by the drive's parameters, from by_X, by_T (3, 3) of its coefficients."""
    for d in range(3):
        s = 0.0
        for k in range(3):
            s += by_X[d, k] * X[k] + by_T[d, k] * T[k]
        rows.J[i, q, rows.J.shape[2] - N_DRIVE + d] = s


@njit(cache=True, nogil=True)
def increment_rows(start, weights, track, moving, wheels, c, measured, rows):
    """Four rows of each of n increments, not whitened, see `drive_rows`.

    start (n + 1,), weights (m,): see Instants; track, moving: motion at these instants; c: Coefficients; measured
    (n, 4).
    """
    wanted = len(rows.J) > 0
    n_c = 1 + track.J_imu.shape[2]
    M0, M1, Mc, D = np.empty((6, KEYFRAME_DIM)), np.empty((6, KEYFRAME_DIM)), np.empty((6, n_c)), np.empty(3)
    X, T, aY, aT = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(start) - 1):
        a, b, g = start[i], start[i + 1] - 1, min(i, len(c.X) - 1)
        M0[:], M1[:], Mc[:], D[:], X[:], T[:] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(a + 1, b):
            _add_travel(
                j, weights[j], track, moving, D, M0 if track.keyframe[j] == track.keyframe[a] else M1, Mc, wanted
            )  # fmt: skip
        theta = _turn(a, b, track, M0, M1, Mc, wanted)
        Y = D + _cross(theta, wheels.p)
        _add(wheels.R, Y, 1.0, -1, X)
        _add(wheels.R, theta, 1.0, -1, T)
        for q in range(4):
            s = 0.0
            for k in range(3):
                s += c.X[g, q, k] * X[k] + c.T[g, q, k] * T[k]
            rows.residual[i, q] = s - measured[i, q]
            if not wanted:
                continue
            _in_imu_axes(wheels, c.X[g, q], c.T[g, q], aY, aT)
            _fill_row(i, q, c.X[g, q], c.T[g, q], aY, aT, X, T, M0, M1, Mc, rows)
            lever = _cross(aY, theta)
            for k in range(3):
                rows.J[i, q, KEYFRAME_PAIR_DIM + 3 + k] = lever[k]
            _by_drive(i, q, c.by_X[g, q], c.by_T[g, q], X, T, rows)
