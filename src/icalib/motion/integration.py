"""Integration of IMU readings between two instants, forwards or backwards, with Jacobians and covariance.

Readings sample band-limited signals. Between two stamps each is the parabola through both readings whose mean is that
of the signal (`ImuData.signals`). A step takes this mean over its part of the interval as constant, and adds the
second-order terms of the variation: coning, sculling and scrolling (Savage, Strapdown inertial navigation integration
algorithm design, JGCD 1998). With the changes d of the rate and e of the force over a step of dt,

    w <- w + dt (w x d) / 12
    f <- f + dt (w x e + f x d) / 12
    p <- p - dt^2 (e + dt (w x e) / 2) / 12

The vectors in these terms are readings as recorded. Biases and intrinsics would change them by less than noise does,
and Jacobians stay exact.

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
    AT_STEP,
    AT_V,
    J_STRIDE,
    ROW_F,
    ROW_G,
    ROW_H,
    RUN_SIZE,
    add_covariance,
    cross,
    matrix,
    start,
    step,
    times,
)
from icalib.optim.state import State


class Readings(NamedTuple):
    """t (N,) seconds on the IMU clock; gyro, accel (N, 3): rates [rad/s] and specific forces [m/s^2] at the stamps;
    means (N - 1, 6): of each interval; variance (N - 1, 3), walk (2,): see `ImuData`."""

    t: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    means: np.ndarray
    variance: np.ndarray
    walk: np.ndarray


class Increment(NamedTuple):
    """R (3, 3), v (3,), p (3,): the increments; J (9, 6 or 30): their Jacobian by gyroscope bias, accelerometer bias
    and, if 30, the 24 IMU intrinsics; P (15, 15): covariance. J and P are empty if not wanted."""

    R: np.ndarray
    v: np.ndarray
    p: np.ndarray
    J: np.ndarray
    P: np.ndarray


@njit(cache=True, nogil=True)
def _part(x, j, c, mean, a, b):
    """Mean and change of column c of x (N, 3) from a to b in interval j, over which its mean is `mean`; -1/2 is the
    first stamp, 1/2 the last."""
    x0, x1 = x[j, c], x[j + 1, c]
    slope, bend = x1 - x0, 3.0 * (x0 + x1) - 6.0 * mean
    return (
        mean + 0.5 * slope * (a + b) + bend * ((a * a + a * b + b * b) / 3.0 - 1.0 / 12.0),
        (b - a) * (slope + bend * (a + b)),
    )


@njit(cache=True, nogil=True)
def _part_of_signals(readings, j, a, b):
    """`_part` of rate and specific force: their means, then their changes, (3,) each."""
    gyro, accel, means = readings.gyro, readings.accel, readings.means
    w0, d0 = _part(gyro, j, 0, means[j, 0], a, b)
    w1, d1 = _part(gyro, j, 1, means[j, 1], a, b)
    w2, d2 = _part(gyro, j, 2, means[j, 2], a, b)
    f0, e0 = _part(accel, j, 0, means[j, 3], a, b)
    f1, e1 = _part(accel, j, 1, means[j, 4], a, b)
    f2, e2 = _part(accel, j, 2, means[j, 5], a, b)
    return (w0, w1, w2), (f0, f1, f2), (d0, d1, d2), (e0, e1, e2)


@njit(cache=True, nogil=True)
def _corrected(w, f, bias, by):
    """Body rate and specific force (3,) from readings w, f, without biases and errors of the intrinsics."""
    w = w[0] - bias[0], w[1] - bias[1], w[2] - bias[2]
    f = f[0] - bias[3], f[1] - bias[4], f[2] - bias[5]
    x, y = times(matrix(by, ROW_G), w), times(matrix(by, ROW_H), f)
    return (x[0] + y[0], x[1] + y[1], x[2] + y[2]), times(matrix(by, ROW_F), f)


@njit(cache=True, nogil=True)
def corrected(readings, j, at, bias, by):
    """Body rate and specific force (3,) at `at` of interval j: -1/2 at its first stamp, 1/2 at its last."""
    w, f, _, _ = _part_of_signals(readings, j, at, at)
    return _corrected(w, f, bias, by)


@njit(cache=True, nogil=True)
def _effective(readings, j, a, b, dt, bias, by):
    """Corrected rate and force (3,) that, constant over the step of dt [s] from a to b (as in `_part`), give its
    rotation and velocity; and its displacement (3,) [m] beyond theirs."""
    w, f, d, e = _part_of_signals(readings, j, a, b)
    wd, we, fd, c = cross(w, d), cross(w, e), cross(f, d), dt / 12.0
    rate, force = _corrected(
        (w[0] + c * wd[0], w[1] + c * wd[1], w[2] + c * wd[2]),
        (f[0] + c * (we[0] + fd[0]), f[1] + c * (we[1] + fd[1]), f[2] + c * (we[2] + fd[2])),
        bias,
        by,
    )
    b, h = -c * dt, 0.5 * dt
    return rate, force, (b * (e[0] + h * we[0]), b * (e[1] + h * we[1]), b * (e[2] + h * we[2]))


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
    t = readings.t
    backwards, last, rate, force = t1 < now, len(t) - 2, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    while True:
        if backwards:
            bound, is_outermost, is_last = t[j], j <= 0, t[j] <= t1 or (j <= 0 and now <= t[j])
        else:
            bound, is_outermost, is_last = t[j + 1], j >= last, t[j + 1] >= t1 or (j >= last and now >= t[j + 1])
        if is_last and whole_intervals:
            break
        end = t1 if is_last else bound
        if end != now:
            a, b = place_in_interval(t, j, now), place_in_interval(t, j, end)
            rate, force, beyond = _effective(readings, j, a, b, end - now, bias, by)
            turn, by_turn = step(rate, force, beyond, end - now, by, run, width)
            if len(cov) > 0:
                add_covariance(turn, by_turn, end - now, readings.variance[j], readings.walk, run, cov, cov_t)
        if is_last:
            rate, force = corrected(readings, j, place_in_interval(t, j, t1), bias, by)
            break
        now = end
        if not is_outermost:
            j += -1 if backwards else 1
    return j, now, rate, force


@njit(cache=True, nogil=True)
def place_in_interval(t, j, at):
    """Where the time `at` is in interval j: -1/2 at its first stamp, 1/2 at its last, clipped to these."""
    return min(max((at - t[j]) / (t[j + 1] - t[j]), 0.0), 1.0) - 0.5


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
    last reading holds. Returns the corrected rate (3,) and specific force (3,) at t1.
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


def readings_of(imu: ImuData) -> Readings:
    """`imu` as arrays for kernels."""
    return Readings(imu.seconds, *imu.signals, imu.variance, imu.walk)


# Propagation of the IMU's pose from keyframes to other instants, forwards or backwards, by its readings.


class Keyframes(NamedTuple):
    """Keyframes of a `State` as arrays for compiled kernels, and gravity [m/s^2]."""

    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    bias: np.ndarray
    gravity: float


def keyframes_of(state: State, gravity: float) -> Keyframes:
    """Keyframes of `state` as arrays; gravity [m/s^2]."""
    return Keyframes(state.seconds, state.rotation, state.position, state.velocity, state.bias, gravity)


class PropagationQuery(NamedTuple):
    """n instants to propagate to. times (n,): seconds on the IMU clock; keyframe (n,): keyframe to start from; first
    (n,): interval of the readings at the start; order (n,): see `in_order_of_keyframes`."""

    times: np.ndarray
    keyframe: np.ndarray
    first: np.ndarray
    order: np.ndarray


class ImuMotion(NamedTuple):
    """Pose and velocity of the IMU at n instants: R_world_imu (n, 3, 3), p_world_imu (n, 3) [m], rate (n, 3) [rad/s,
    IMU frame], velocity (n, 3) [m/s, world]."""

    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray

    @classmethod
    def empty(cls, n: int) -> ImuMotion:
        """Uninitialised arrays for n instants."""
        return cls(np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3)))


@njit(cache=True, nogil=True)
def integrate_from_keyframe(keyframe, t0, t1, first, bias, readings, by, prefix, run, width):
    """As `integrate`, without covariance and into `run` (RUN_SIZE,).

    `prefix` (RUN_SIZE + 3,) is the integral over whole intervals from the same keyframe in the same direction. Its last
    three elements are an identifier of both, the interval, and the instant reached. It is extended to t1, so that many
    instants in the order of `in_order_of_keyframes` cost little more than the last one.
    """
    backwards = t1 < t0
    identifier = 2 * keyframe + backwards
    if prefix[RUN_SIZE] != identifier or (t1 >= prefix[RUN_SIZE + 2] if backwards else t1 <= prefix[RUN_SIZE + 2]):
        start(prefix)
        prefix[RUN_SIZE], prefix[RUN_SIZE + 1], prefix[RUN_SIZE + 2] = identifier, first, t0
    none, j, now, rate, force = (
        prefix[:0],
        int(prefix[RUN_SIZE + 1]),
        prefix[RUN_SIZE + 2],
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0),
    )
    for part in range(2):  # whole intervals, and then the rest
        x = run if part else prefix
        j, now, rate, force = advance(t1, part == 0, j, now, bias, readings, by, x, width, none, none)
        if part == 0:
            prefix[RUN_SIZE + 1], prefix[RUN_SIZE + 2] = j, now
            for i in range(RUN_SIZE if width else AT_STEP):
                run[i] = prefix[i]
    return rate, force


@njit(cache=True, nogil=True)
def empty_prefix():
    """Initial `prefix` of `integrate_from_keyframe`: the identifier -1, of no keyframe, so that it starts anew."""
    prefix = np.zeros(RUN_SIZE + 3)
    prefix[RUN_SIZE] = -1.0
    return prefix


@njit(cache=True, nogil=True)
def rotation_of(keyframes, k):
    """R_world_imu of keyframe k, row by row as nine numbers."""
    R = keyframes.rotation
    return R[k, 0, 0], R[k, 0, 1], R[k, 0, 2], R[k, 1, 0], R[k, 1, 1], R[k, 1, 2], R[k, 2, 0], R[k, 2, 1], R[k, 2, 2]


@njit(cache=True, nogil=True)
def place(i, seconds, k, keyframes, increments, rate, out):
    """Fills entry i of `out`, a `ImuMotion`, from keyframe k and the `increments` (see `integration_step`). seconds:
    elapsed time; rate (3,): body rate at the instant."""
    R, g = keyframes.rotation, keyframes.gravity
    for a in range(3):
        out.rate[i, a] = rate[a]
        position = keyframes.position[k, a] + keyframes.velocity[k, a] * seconds
        velocity = keyframes.velocity[k, a]
        for c in range(3):
            out.rotation[i, a, c] = (
                R[k, a, 0] * increments[c] + R[k, a, 1] * increments[3 + c] + R[k, a, 2] * increments[6 + c]
            )
            position += R[k, a, c] * increments[12 + c]
            velocity += R[k, a, c] * increments[9 + c]
        out.position[i, a], out.velocity[i, a] = position, velocity
    out.position[i, 2] -= 0.5 * g * seconds * seconds
    out.velocity[i, 2] -= g * seconds


def in_order_of_keyframes(times: np.ndarray, keyframe: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Order (n,) of sorted instants `times` (n,) in which each follows the one nearer to its `keyframe` (n,): first
    those after their keyframes, then backwards those before. seconds (K,): keyframe times."""
    before = times < seconds[keyframe]
    return np.concatenate([np.flatnonzero(~before), np.flatnonzero(before)[::-1]])


def propagation_query(state: State, times: np.ndarray, keyframe: np.ndarray, imu: ImuData) -> PropagationQuery:
    """Query for sorted `times` (n,) from their `keyframe` (n,)."""
    begin = state.seconds[keyframe]
    first = imu.interval(begin)
    # If the keyframe is at a stamp, backward integration starts in the interval that ends there.
    on_stamp = (times < begin) & (imu.seconds[first] == begin) & (first > 0)
    return PropagationQuery(times, keyframe, first - on_stamp, in_order_of_keyframes(times, keyframe, state.seconds))
