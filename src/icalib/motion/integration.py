"""Integration of IMU readings between two instants, forwards or backwards, with Jacobians and covariance.

Between two IMU stamps body rate and specific force are constant, the mean of the two readings; see `integration_step`.
Increments are relative to the start: R_0^T R_1; R_0^T (v_1 - v_0 - g T); R_0^T (p_1 - p_0 - v_0 T - g T^2/2). Errors
are rotation (on the right), velocity, position, gyroscope bias, accelerometer bias, in this order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.motion.imu_data import ImuData
from icalib.motion.integration_step import (
    AT_J,
    AT_P,
    AT_V,
    J_STRIDE,
    ROW_F,
    ROW_G,
    ROW_H,
    RUN_SIZE,
    add_covariance,
    matrix,
    start,
    step,
    times,
)


class Readings(NamedTuple):
    """t (N,) seconds on the IMU clock; gyro, accel (N, 3); variance (N, 3), walk (2,): see `ImuData`.

    linear: readings are interpolated linearly between stamps, and a part of an interval uses their mean over that part.
    Whole intervals are unchanged. The pose at the end then has a continuous time derivative.
    """

    t: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    variance: np.ndarray
    walk: np.ndarray
    linear: bool


class Increment(NamedTuple):
    """R (3, 3), v (3,), p (3,): the increments; J (9, 6 or 30): their Jacobian by gyroscope bias, accelerometer bias
    and, if 30, the 24 IMU intrinsics; P (15, 15): covariance. J and P are empty if not wanted."""

    R: np.ndarray
    v: np.ndarray
    p: np.ndarray
    J: np.ndarray
    P: np.ndarray


@njit(cache=True, nogil=True)
def corrected(gyro, accel, j, share, bias, by):
    """Body rate and specific force (3,), from readings interpolated at `share` of the interval from stamp j to j +
    1."""
    w = (
        gyro[j, 0] + share * (gyro[j + 1, 0] - gyro[j, 0]) - bias[0],
        gyro[j, 1] + share * (gyro[j + 1, 1] - gyro[j, 1]) - bias[1],
        gyro[j, 2] + share * (gyro[j + 1, 2] - gyro[j, 2]) - bias[2],
    )
    f = (
        accel[j, 0] + share * (accel[j + 1, 0] - accel[j, 0]) - bias[3],
        accel[j, 1] + share * (accel[j + 1, 1] - accel[j, 1]) - bias[4],
        accel[j, 2] + share * (accel[j + 1, 2] - accel[j, 2]) - bias[5],
    )
    A, B = matrix(by, ROW_G), matrix(by, ROW_H)
    rate = (
        A[0] * w[0] + B[0] * f[0] + (A[1] * w[1] + B[1] * f[1]) + (A[2] * w[2] + B[2] * f[2]),
        A[3] * w[0] + B[3] * f[0] + (A[4] * w[1] + B[4] * f[1]) + (A[5] * w[2] + B[5] * f[2]),
        A[6] * w[0] + B[6] * f[0] + (A[7] * w[1] + B[7] * f[1]) + (A[8] * w[2] + B[8] * f[2]),
    )
    return rate, times(matrix(by, ROW_F), f)


@njit(cache=True, nogil=True)
def bias_of(bias, k):
    """Row k of bias (K, 6), as six numbers."""
    return bias[k, 0], bias[k, 1], bias[k, 2], bias[k, 3], bias[k, 4], bias[k, 5]


@njit(cache=True, nogil=True)
def advance(t1, whole_intervals, j, now, bias, readings, by, run, width, cov, cov_t):
    """Advances `run` from `now` [s], in interval j of the readings, to t1 [s]; t1 < `now` integrates backwards.

    With `whole_intervals` it stops where the interval that holds t1, or the last one, is entered. width: columns of J
    in use. cov, cov_t: see `integration_workspace`; of length 0 without a covariance. Returns the last interval, the
    time [s] at which it is entered, and rate [rad/s] and specific force [m/s^2] (3,) at t1. Rate and force are of no
    use with `whole_intervals`.
    """
    t, gyro, accel, linear = readings.t, readings.gyro, readings.accel, readings.linear
    backwards, last, rate, force = t1 < now, len(t) - 2, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    while True:
        is_last = (j <= 0 or t[j] <= t1) if backwards else (j >= last or t[j + 1] >= t1)
        if is_last and whole_intervals:
            break
        end = t1 if is_last else (t[j] if backwards else t[j + 1])
        share = _share(t, j, 0.5 * (now + end)) if linear else 0.5
        rate, force = corrected(gyro, accel, j, share, bias, by)
        if end != now:
            turn, by_turn = step(rate, force, end - now, by, run, width)
            if len(cov) > 0:
                add_covariance(turn, by_turn, end - now, readings.variance[j], readings.walk, run, cov, cov_t)
        if is_last:
            if linear:
                rate, force = corrected(gyro, accel, j, _share(t, j, t1), bias, by)
            break
        now = end
        j += -1 if backwards else 1
    return j, now, rate, force


@njit(cache=True, nogil=True)
def _share(t, j, at):
    """Fraction of the interval from stamp j to the next at time `at`, clipped to 0..1."""
    return min(max((at - t[j]) / (t[j + 1] - t[j]), 0.0), 1.0)


@njit(cache=True, nogil=True)
def finish(run, cov, out):
    """Copies `run` and `cov` to `out`, an `Increment`."""
    for i in range(3):
        out.v[i], out.p[i] = run[AT_V + i], run[AT_P + i]
        for k in range(3):
            out.R[i, k] = run[3 * i + k]
    for i in range(9):
        for c in range(out.J.shape[1]):
            out.J[i, c] = run[AT_J + J_STRIDE * i + c]
    for i in range(len(out.P)):
        for c in range(15):
            out.P[i, c] = cov[AT_J + J_STRIDE * i + c]


@njit(cache=True, nogil=True)
def integrate(t0, t1, first, bias, readings, by, workspace, out):
    """Integrates `readings` from t0 to t1 (seconds on the IMU clock; t1 < t0 integrates backwards), starting in
    interval `first`; overwrites `out`, an `Increment`.

    bias: six numbers; by: see `correction`; workspace: see `integration_workspace`. Beyond the recording, the first or
    last interval is extrapolated. Returns the corrected rate (3,) and specific force (3,) at t1.
    """
    run, cov, cov_t = workspace
    start(run)
    for i in range(len(cov)):
        cov[i] = 0.0
    whole_intervals = (
        len(run) == 0
    )  # False; the literal would be a type of its own, for which all is compiled once more
    width = out.J.shape[1]
    _, _, rate, force = advance(t1, whole_intervals, first, t0, bias, readings, by, run, width, cov, cov_t)
    finish(run, cov, out)
    return rate, force


@njit(cache=True, nogil=True)
def integration_workspace(n):
    """Workspace of `integrate`; n: COVARIANCE_SIZE with a covariance, else 0."""
    return np.empty(RUN_SIZE), np.empty(n), np.empty(n)


def readings_of(imu: ImuData, linear: bool) -> Readings:
    """`imu` as arrays for kernels; linear: see `Readings`."""
    return Readings(imu.seconds, imu.gyro, imu.accel, imu.variance, imu.walk, linear)
