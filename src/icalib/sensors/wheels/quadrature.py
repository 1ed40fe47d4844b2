"""At which instants the motion of wheels is integrated between two of their stamps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.motion.stamp_intervals import StampIntervals

# Two Gauss points a panel miss u'''' h^5 / 4320 of the integral of u: a vibration of 20 Hz and 3 m/s^2 costs 0.01 mm.
PANEL_S = 0.025


class Instants(NamedTuple):
    """Where motion is looked at. Those of interval i are start[i]:start[i+1]: its first end, points of a quadrature,
    its last end. times (m,) s on the wheels' clock; `keyframe` (m,); weight (m,) s of the quadrature, zero at the
    ends."""

    start: np.ndarray
    times: np.ndarray
    keyframe: np.ndarray
    weight: np.ndarray


def quadrature(seconds: np.ndarray, intervals: StampIntervals, change: np.ndarray | None = None) -> Instants:
    """Gauss's two points in panels of at most PANEL_S, those before `change` (n,) s of each interval, by default its
    middle, seen from its first keyframe, the others from the other; seconds (N,): the stamps."""
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
    keyframe = intervals.keyframe[interval] + (times > change[interval])
    times[start[:-1]], times[start[1:] - 1] = begin, seconds[intervals.last]
    keyframe[start[:-1]], keyframe[start[1:] - 1] = intervals.keyframe, intervals.keyframe + 1
    weight[start[:-1]] = weight[start[1:] - 1] = 0.0
    return Instants(start, times, keyframe, weight)
