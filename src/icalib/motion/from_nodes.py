"""From nodes to the instants that hang on them, forwards or backwards, by the IMU's readings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.motion.imu_data import ImuData
from icalib.motion.integration import Increment, start, to_the_end, whole
from icalib.optim.state import State


class Nodes(NamedTuple):
    """Those of a `State`, as kernels take them, and gravity [m/s^2]."""

    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    bias: np.ndarray
    gravity: float


def nodes_of(state: State, gravity: float) -> Nodes:
    return Nodes(state.seconds, state.rotation, state.position, state.velocity, state.bias, gravity)


class Ways(NamedTuple):
    """How n instants are reached: times (n,) seconds on the IMU's clock, node (n,) of each, first (n,) the interval of
    the readings in which its way begins, order (n,) in which to go."""

    times: np.ndarray
    node: np.ndarray
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


class Carried(NamedTuple):
    """How far increments were carried from a node, in whole intervals: node and interval (2,), the instant (1,)."""

    at: np.ndarray
    now: np.ndarray
    so_far: Increment


@njit(cache=True, nogil=True)
def nothing_carried(width):
    """J of `width` columns, no covariance."""
    so_far = Increment(np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((9, width)), np.empty((0, 0)))
    return Carried(np.full(2, -1), np.empty(1), so_far)


@njit(cache=True, nogil=True, inline="always")  # as in integration.py
def integrate_from_node(node, t0, t1, first, bias, readings, by, carried, out):
    """As `integrate`, without a covariance. What was `carried` from the same node in the same direction, and not
    as far as t1, is carried on, so that many instants (`in_order_of_nodes`) cost little more than the last one."""
    rate, force, backwards = by.room.rate, by.room.force, t1 < t0
    so_far, way = carried.so_far, 2 * node + backwards
    if carried.at[0] != way or (t1 >= carried.now[0] if backwards else t1 <= carried.now[0]):
        start(so_far.R, so_far.v, so_far.p, so_far.J, so_far.P)
        carried.at[0], carried.at[1], carried.now[0] = way, first, t0
    j, now = whole(t1, backwards, carried.at[1], carried.now[0], bias, readings, by, so_far, so_far.P, rate, force)
    carried.at[1], carried.now[0] = j, now
    for i in range(3):
        out.v[i], out.p[i] = so_far.v[i], so_far.p[i]
        for k in range(3):
            out.R[i, k] = so_far.R[i, k]
    for i in range(out.J.shape[0]):
        for k in range(out.J.shape[1]):
            out.J[i, k] = so_far.J[i, k]
    to_the_end(t1, j, now, bias, readings, by, out, out.P, rate, force)
    return rate, force


@njit(cache=True, nogil=True)
def place(i, seconds, k, nodes, way, rate, out):
    """Fills entry i of `out`, a `Moving`, `seconds` and increments `way` from node k."""
    R, g = nodes.rotation[k], nodes.gravity
    for a in range(3):
        out.rate[i, a] = rate[a]
        out.position[i, a] = nodes.position[k, a] + nodes.velocity[k, a] * seconds
        out.velocity[i, a] = nodes.velocity[k, a]
        for c in range(3):
            out.rotation[i, a, c] = R[a, 0] * way.R[0, c] + R[a, 1] * way.R[1, c] + R[a, 2] * way.R[2, c]
            out.position[i, a] += R[a, c] * way.p[c]
            out.velocity[i, a] += R[a, c] * way.v[c]
    out.position[i, 2] -= 0.5 * g * seconds * seconds
    out.velocity[i, 2] -= g * seconds


def in_order_of_nodes(times: np.ndarray, node: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """(n,) the order in which instants at `times` (n,), in order themselves, lead away from their `node` (n,), which
    are at `seconds` (K,): first all behind their nodes, then backwards those before."""
    before = times < seconds[node]
    return np.concatenate([np.flatnonzero(~before), np.flatnonzero(before)[::-1]])


def ways_from(state: State, times: np.ndarray, node: np.ndarray, imu: ImuData) -> Ways:
    """To `times` (n,), in order, from their `node` (n,)."""
    begin = state.seconds[node]
    first = imu.interval(begin)
    # Integration backwards starts in the interval that ends at the node, if the node lies on a stamp.
    on_stamp = (times < begin) & (imu.seconds[first] == begin) & (first > 0)
    return Ways(times, node, first - on_stamp, in_order_of_nodes(times, node, state.seconds))
