"""Instants and weights of the quadrature that integrates the motion of wheels between two of their stamps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.motion.stamp_intervals import StampIntervals

# Largest length of a panel. The error of two Gauss points is u'''' h^5 / 4320: 0.01 mm for 20 Hz vibration of 3 m/s^2.
PANEL_S = 0.025


class Instants(NamedTuple):
    """The m instants at which the motion is evaluated for n intervals.

    start (n + 1,): interval i has the instants start[i]:start[i+1]: its begin, the quadrature points, its end. times
    (m,) [s] on the wheels' clock; keyframe (m,): keyframe from which the motion is propagated; weight (m,) [s]:
    quadrature weight, zero at begin and end.
    """

    start: np.ndarray
    times: np.ndarray
    keyframe: np.ndarray
    weight: np.ndarray


def quadrature(seconds: np.ndarray, intervals: StampIntervals, change: np.ndarray | None = None) -> Instants:
    """Instants with two Gauss points in each panel of at most PANEL_S; seconds (N,): the stamps of the wheels.

    change (n,) [s] on the wheels' clock: instants up to `change` are propagated from the first keyframe of the
    interval, later ones from the second; by default the middle of the interval.
    """
    begin = seconds[intervals.first]
    length = seconds[intervals.last] - begin
    # Each half of an interval is split into panels. Its instants are begin, two Gauss points per panel, and end.
    panels = np.maximum(np.ceil(0.5 * length / PANEL_S - 1e-6), 1.0).astype(np.int64)  # in half an interval
    start = np.concatenate([[0], np.cumsum(2 + 4 * panels)])
    interval = np.repeat(np.arange(len(begin)), np.diff(start))
    at = np.arange(start[-1]) - start[interval] - 1
    width = (0.5 * length / panels)[interval]
    panel, second = at // 2, at % 2
    times = begin[interval] + (panel + 0.5 + (second - 0.5) / np.sqrt(3.0)) * width
    weight = 0.5 * width
    change = begin + 0.5 * length if change is None else change
    keyframe = intervals.keyframe[interval] + (times > change[interval])
    # begin and end of the intervals have no weight: only poses are evaluated there
    times[start[:-1]], times[start[1:] - 1] = begin, seconds[intervals.last]
    keyframe[start[:-1]], keyframe[start[1:] - 1] = intervals.keyframe, intervals.keyframe + 1
    weight[start[:-1]] = weight[start[1:] - 1] = 0.0
    return Instants(start, times, keyframe, weight)
