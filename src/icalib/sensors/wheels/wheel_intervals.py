"""Between which wheel stamps the wheels are compared with the motion, and where that motion is looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.motion.imu_data import ImuData

LONGEST_S = 0.5  # intervals longer than this are no longer consistent
# Two Gauss points a panel miss u'''' h^5 / 4320 of the integral of u: a vibration of 20 Hz and 3 m/s^2 costs 0.01 mm.
PANEL_S = 0.025


@dataclass(frozen=True)
class WheelIntervals:
    """n stretches between wheel stamps `first` and `last` (n,). The first end hangs on `node` (n,), in order, the last
    one on the node after it."""

    first: np.ndarray
    last: np.ndarray
    node: np.ndarray


def choose_intervals(imu: ImuData, nodes: np.ndarray, starts: tuple[int, ...], times: np.ndarray) -> WheelIntervals:
    """Stretches from the stamp nearest to a node to the one nearest to the next; `times` (N,): stamps on the imu clock.

    Where nodes are denser than stamps, neighbours may share a stamp; the stretch to the next stamp then hangs on the
    two nodes about its middle. None leaves the IMU's recording, touches a gap in it, or goes from one of the recordings
    that begin at the nodes `starts` to another. Where motion is carried forwards only (see `ImuData`), the stamp is the
    first after the node.
    """
    after = np.clip(np.searchsorted(times, nodes), 1, len(times) - 1)
    near = after if imu.forwards else after - (nodes - times[after - 1] < times[after] - nodes)
    a, b = times[near[:-1]], times[near[1:]]
    good = (a < b) & (b - a <= LONGEST_S) & (a >= imu.seconds[0]) & (b <= imu.seconds[-1])
    for start, end in (*imu.gaps, *imu.seams):
        good &= (b <= start) | (a >= end)
    good[np.array(starts[1:], dtype=np.int64) - 1] = False
    node = np.flatnonzero(good)
    return WheelIntervals(near[node], near[node + 1], node)


def pose_intervals(imu: ImuData, nodes: np.ndarray, starts: tuple[int, ...], times: np.ndarray) -> WheelIntervals:
    """All stretches from one stamp to the next, each on the two nodes about its middle; `times` (N,): stamps on the imu
    clock. None leaves the IMU's recording, touches a gap in it, or lies beyond the nodes or between recordings."""
    a, b = times[:-1], times[1:]
    middle = 0.5 * (a + b)
    good = (b - a <= LONGEST_S) & (a >= imu.seconds[0]) & (b <= imu.seconds[-1])
    good &= (middle > nodes[0]) & (middle < nodes[-1])
    for start, end in (*imu.gaps, *imu.seams):
        good &= (b <= start) | (a >= end)
    node = np.searchsorted(nodes, middle) - 1
    good &= ~np.isin(node + 1, starts)
    k = np.flatnonzero(good)
    return WheelIntervals(k, k + 1, node[k])


class Instants(NamedTuple):
    """Where motion is looked at. Those of interval i are start[i]:start[i+1]: its first end, points of a quadrature,
    its last end. times (m,) s on the wheels' clock; node (m,); weight (m,) s of the quadrature, zero at the ends."""

    start: np.ndarray
    times: np.ndarray
    node: np.ndarray
    weight: np.ndarray


def quadrature(seconds: np.ndarray, intervals: WheelIntervals, change: np.ndarray | None = None) -> Instants:
    """Gauss's two points in panels of at most PANEL_S, those before `change` (n,) s of each interval, by default its
    middle, seen from its first node, the others from the other; seconds (N,): the stamps."""
    begin = seconds[intervals.first]
    length = seconds[intervals.last] - begin
    panels = np.maximum(np.ceil(0.5 * length / PANEL_S - 1e-6), 1.0).astype(np.int64)  # of a half
    start = np.concatenate([[0], np.cumsum(2 + 4 * panels)])
    interval = np.repeat(np.arange(len(begin)), np.diff(start))
    at = np.arange(start[-1]) - start[interval] - 1
    width = (0.5 * length / panels)[interval]
    panel, second = at // 2, at % 2
    times = begin[interval] + (panel + 0.5 + (second - 0.5) / np.sqrt(3.0)) * width
    weight = 0.5 * width
    change = begin + 0.5 * length if change is None else change
    node = intervals.node[interval] + (times > change[interval])
    times[start[:-1]], times[start[1:] - 1] = begin, seconds[intervals.last]
    node[start[:-1]], node[start[1:] - 1] = intervals.node, intervals.node + 1
    weight[start[:-1]] = weight[start[1:] - 1] = 0.0
    return Instants(start, times, node, weight)
