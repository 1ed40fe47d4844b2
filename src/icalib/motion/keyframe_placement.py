"""Where the keyframes of the chain stand: at every distinct image instant, and often enough in between."""

from __future__ import annotations

import numpy as np

from icalib.motion.imu_data import ImuData, clear_of

MERGED_WITHIN_S = 2e-3  # images closer than this share a keyframe
SPACING_SLACK = 0.1  # of the spacing: a camera of 20 Hz whose stamps jitter needs no keyframe in between


def place_keyframes(imu: ImuData, image_times: list[np.ndarray], spacing: float, max_gap: float) -> np.ndarray:
    """(K,) keyframe times, seconds on the imu clock: all image instants, none further apart than 1.1 `spacing`.

    IMU gaps are filled too, up to `max_gap` seconds; in longer ones there is no keyframe, and none between recordings.
    """
    times = np.sort(np.concatenate(image_times))
    own = distinct(times[usable(imu, times, max_gap)])
    parts = [_filled(recorded, spacing) for recorded in np.split(own, first_keyframes(imu, own)[1:])]
    keyframes = np.concatenate(parts)
    return keyframes[clear_of(_long_gaps(imu, max_gap), keyframes, keyframes)]


def _filled(times: np.ndarray, spacing: float) -> np.ndarray:
    """Sorted `times` (n,), and instants evenly in between where they are further apart than 1.1 `spacing`."""
    apart = np.diff(times)
    steps = np.maximum(np.ceil(apart / spacing - SPACING_SLACK), 1.0).astype(np.int64)
    last = np.cumsum(steps)
    k = np.arange(1, steps.sum() + 1) - np.repeat(last - steps, steps)
    filled = np.append(times[:1], np.repeat(times[:-1], steps) + k * np.repeat(apart / steps, steps))
    filled[last] = times[1:]
    return filled


def first_keyframes(imu: ImuData | None, keyframes: np.ndarray) -> tuple[int, ...]:
    """The first of the `keyframes` (K,) of each recording; without an IMU keyframes know of no recordings."""
    seams = () if imu is None else imu.seams
    return (0, *(int(k) for k in np.searchsorted(keyframes, [end for end, _ in seams], side="right")))


def distinct(times: np.ndarray) -> np.ndarray:
    """The first of each group of sorted `times` that lie close together."""
    return times[np.diff(times, prepend=-np.inf) > MERGED_WITHIN_S]


def usable(imu: ImuData, times: np.ndarray, max_gap: float) -> np.ndarray:
    """(n,) whether the IMU was running at each time, gaps up to `max_gap` seconds allowed."""
    inside = (times >= imu.seconds[0]) & (times <= imu.seconds[-1])
    return inside & clear_of((*_long_gaps(imu, max_gap), *imu.seams), times, times)


def _long_gaps(imu: ImuData, max_gap: float) -> list[tuple[float, float]]:
    return [(a, b) for a, b in imu.gaps if b - a > max_gap]
