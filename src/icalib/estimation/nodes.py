"""Where the nodes of the chain stand: at every distinct image instant, and often enough in between."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from icalib.estimation.imu_data import ImuData

MERGED_WITHIN_S = 2e-3  # images closer than this share a node
SLACK = 0.1  # of the spacing: a camera of 20 Hz whose stamps jitter needs no node in between


def place_nodes(imu: ImuData, image_times: list[np.ndarray], spacing: float, max_gap: float) -> np.ndarray:
    """(K,) node times, seconds on the imu clock: all image instants, none further apart than 1.1 `spacing`.

    IMU gaps are filled too, up to `max_gap` seconds; in longer ones there is no node, and none between recordings.
    """
    times = np.sort(np.concatenate(image_times))
    own = distinct(times[usable(imu, times, max_gap)])
    long_gaps = [(a, b) for a, b in imu.gaps if b - a > max_gap]
    pieces = []
    for recorded in np.split(own, first_nodes(imu, own)[1:]):
        pieces.append(recorded[:1])
        for a, b in pairwise(recorded):
            n = max(int(np.ceil((b - a) / spacing - SLACK)), 1)
            between = np.linspace(a, b, n + 1)[1:]
            for start, end in long_gaps:
                between = between[~((between > start) & (between < end))]
            pieces.append(between)
    return np.concatenate(pieces)


def first_nodes(imu: ImuData | None, nodes: np.ndarray) -> tuple[int, ...]:
    """The first of the `nodes` (K,) of each recording; without an IMU nodes know of no recordings."""
    seams = () if imu is None else imu.seams
    return (0, *(int(k) for k in np.searchsorted(nodes, [end for end, _ in seams], side="right")))


def distinct(times: np.ndarray) -> np.ndarray:
    """The first of each group of sorted `times` that lie close together."""
    return times[np.diff(times, prepend=-np.inf) > MERGED_WITHIN_S]


def usable(imu: ImuData, times: np.ndarray, max_gap: float) -> np.ndarray:
    """(n,) whether the IMU was running at each time, gaps up to `max_gap` seconds allowed."""
    inside = (times >= imu.seconds[0]) & (times <= imu.seconds[-1])
    for a, b in (*(gap for gap in imu.gaps if gap[1] - gap[0] > max_gap), *imu.seams):
        inside &= (times <= a) | (times >= b)
    return inside
