"""From keyframes to the instants that hang on them, forwards or backwards, by the IMU's readings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.motion.imu_data import ImuData
from icalib.motion.integration import advance
from icalib.motion.integration_step import AT_STEP, RUN_SIZE, start
from icalib.optim.state import State


class Keyframes(NamedTuple):
    """Those of a `State`, as kernels take them, and gravity [m/s^2]."""

    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    bias: np.ndarray
    gravity: float


def keyframes_of(state: State, gravity: float) -> Keyframes:
    return Keyframes(state.seconds, state.rotation, state.position, state.velocity, state.bias, gravity)


class PropagationQuery(NamedTuple):
    """How n instants are reached: times (n,) seconds on the IMU's clock, keyframe (n,) of each, first (n,) the interval
    of the readings in which its way begins, order (n,) in which to go."""

    times: np.ndarray
    keyframe: np.ndarray
    first: np.ndarray
    order: np.ndarray


class Moving(NamedTuple):
    """The IMU at n instants: R_world_imu (n, 3, 3), p_world_imu (n, 3), rate (n, 3) of the body [rad/s], velocity
    (n, 3) in the world [m/s]."""

    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray

    @classmethod
    def empty(cls, n: int) -> Moving:
        return cls(np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3)))


@njit(cache=True, nogil=True)
def integrate_from_keyframe(keyframe, t0, t1, first, bias, readings, by, carried, run, width):
    """As `integrate`, without a covariance and into `run` (RUN_SIZE,). What was `carried` from the same keyframe in the
    same direction, and not as far as t1, is carried on, so that many instants (`in_order_of_keyframes`) cost little
    more than the last one. carried (RUN_SIZE + 3,): a run through whole intervals; its way, its interval, its
    instant."""
    backwards = t1 < t0
    way = 2 * keyframe + backwards
    if carried[RUN_SIZE] != way or (t1 >= carried[RUN_SIZE + 2] if backwards else t1 <= carried[RUN_SIZE + 2]):
        start(carried)
        carried[RUN_SIZE], carried[RUN_SIZE + 1], carried[RUN_SIZE + 2] = way, first, t0
    none, j, now, rate, force = (
        carried[:0],
        int(carried[RUN_SIZE + 1]),
        carried[RUN_SIZE + 2],
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0),
    )
    for part in range(2):  # whole intervals, and then the rest
        x = run if part else carried
        j, now, rate, force = advance(t1, part == 0, j, now, bias, readings, by, x, width, none, none)
        if part == 0:
            carried[RUN_SIZE + 1], carried[RUN_SIZE + 2] = j, now
            for i in range(RUN_SIZE if width else AT_STEP):
                run[i] = carried[i]
    return rate, force


@njit(cache=True, nogil=True)
def empty_prefix():
    """See `integrate_from_keyframe`."""
    carried = np.zeros(RUN_SIZE + 3)
    carried[RUN_SIZE] = -1.0
    return carried


@njit(cache=True, nogil=True)
def rotation_of(keyframes, k):
    """R_world_imu of keyframe k: nine numbers, row by row."""
    R = keyframes.rotation
    return R[k, 0, 0], R[k, 0, 1], R[k, 0, 2], R[k, 1, 0], R[k, 1, 1], R[k, 1, 2], R[k, 2, 0], R[k, 2, 1], R[k, 2, 2]


@njit(cache=True, nogil=True)
def place(i, seconds, k, keyframes, way, rate, out):
    """Fills entry i of `out`, a `Moving`, `seconds` and increments `way` (15,), see `integration_step`, from keyframe
    k."""
    R, g = keyframes.rotation, keyframes.gravity
    for a in range(3):
        out.rate[i, a] = rate[a]
        position = keyframes.position[k, a] + keyframes.velocity[k, a] * seconds
        velocity = keyframes.velocity[k, a]
        for c in range(3):
            out.rotation[i, a, c] = R[k, a, 0] * way[c] + R[k, a, 1] * way[3 + c] + R[k, a, 2] * way[6 + c]
            position += R[k, a, c] * way[12 + c]
            velocity += R[k, a, c] * way[9 + c]
        out.position[i, a], out.velocity[i, a] = position, velocity
    out.position[i, 2] -= 0.5 * g * seconds * seconds
    out.velocity[i, 2] -= g * seconds


def in_order_of_keyframes(times: np.ndarray, keyframe: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """(n,) the order in which instants at `times` (n,), in order themselves, lead away from their `keyframe` (n,),
    which are at `seconds` (K,): first all behind their keyframes, then backwards those before."""
    before = times < seconds[keyframe]
    return np.concatenate([np.flatnonzero(~before), np.flatnonzero(before)[::-1]])


def propagation_query(state: State, times: np.ndarray, keyframe: np.ndarray, imu: ImuData) -> PropagationQuery:
    """To `times` (n,), in order, from their `keyframe` (n,)."""
    begin = state.seconds[keyframe]
    first = imu.interval(begin)
    # Integration backwards starts in the interval that ends at the keyframe, if the keyframe lies on a stamp.
    on_stamp = (times < begin) & (imu.seconds[first] == begin) & (first > 0)
    return PropagationQuery(times, keyframe, first - on_stamp, in_order_of_keyframes(times, keyframe, state.seconds))
