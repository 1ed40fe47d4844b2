"""Instants and weights of the quadrature that integrates the motion of wheels between two of their stamps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.motion.stamp_intervals import StampIntervals

# Length of a panel. The error of two Gauss points is u'''' h^5 / 4320: 0.01 mm for a vibration of 20 Hz and 3 m/s^2.
PANEL_S = 0.025


class Instants(NamedTuple):
    """m instants of n intervals.

    start (n + 1,): those of interval i are start[i]:start[i+1], its first end, the points of the quadrature, its last
    end. times (m,) s on the wheels' clock; keyframe (m,): from which the motion is propagated; weight (m,) s, zero at
    the ends.
    """

    start: np.ndarray
    times: np.ndarray
    keyframe: np.ndarray
    weight: np.ndarray


def quadrature(seconds: np.ndarray, intervals: StampIntervals, change: np.ndarray | None = None) -> Instants:
    """Two Gauss points in each panel of at most PANEL_S; seconds (N,): the stamps.

    change (n,) s on the wheels' clock: instants up to it are propagated from the first keyframe of the interval, later
    ones from the second; by default the middle.
    """
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
