"""Propagation of the IMU's pose from keyframes to other instants, forwards or backwards, by its readings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.motion.imu_data import ImuData
from icalib.motion.integration import advance
from icalib.motion.integration_step import AT_STEP, RUN_SIZE, start
from icalib.optim.state import State


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
