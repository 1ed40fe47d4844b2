"""Placement of keyframes: at every distinct image instant, and evenly spaced between distant ones."""

from __future__ import annotations

import numpy as np

from icalib.motion.imu_data import ImuData, clear_of

MERGED_WITHIN_S = 2e-3  # images closer in time share a keyframe
SPACING_SLACK = 0.1  # of the spacing: intervals longer by up to this get no keyframe, so that jitter adds none


def place_keyframes(imu: ImuData, image_times: list[np.ndarray], spacing: float, max_gap: float) -> np.ndarray:
    """Keyframe times (K,), seconds on the IMU clock: all image instants, none further apart than 1.1 `spacing` s.

    IMU gaps up to `max_gap` seconds have keyframes too; longer ones, and intervals between recordings, have none.
    """
    times = np.sort(np.concatenate(image_times))
    instants = distinct(times[usable(imu, times, max_gap)])
    parts = [_filled(recorded, spacing) for recorded in np.split(instants, first_keyframes(imu, instants)[1:])]
    keyframes = np.concatenate(parts)
    return keyframes[clear_of(_long_gaps(imu, max_gap), keyframes, keyframes)]


def _filled(times: np.ndarray, spacing: float) -> np.ndarray:
    """Sorted `times` (n,) with evenly spaced instants inserted where they are further apart than 1.1 `spacing`."""
    apart = np.diff(times)
    steps = np.maximum(np.ceil(apart / spacing - SPACING_SLACK), 1.0).astype(np.int64)
    last = np.cumsum(steps)
    k = np.arange(1, steps.sum() + 1) - np.repeat(last - steps, steps)
    filled = np.append(times[:1], np.repeat(times[:-1], steps) + k * np.repeat(apart / steps, steps))
    filled[last] = times[1:]
    return filled


def first_keyframes(imu: ImuData | None, keyframes: np.ndarray) -> tuple[int, ...]:
    """Index of the first keyframe of each recording, in `keyframes` (K,) s; (0,) without an IMU."""
    seams = () if imu is None else imu.seams
    return (0, *(int(k) for k in np.searchsorted(keyframes, [end for end, _ in seams], side="right")))


def distinct(times: np.ndarray) -> np.ndarray:
    """The first of each group of sorted `times` within MERGED_WITHIN_S of one another."""
    return times[np.diff(times, prepend=-np.inf) > MERGED_WITHIN_S]


def spaced(seconds: np.ndarray, spacing: float) -> np.ndarray:
    """The first of `seconds` (n,), increasing, in each interval of length `spacing` [s]; and the last of all."""
    k = np.flatnonzero(np.diff(np.floor(seconds / spacing + 1e-6), prepend=-1.0))
    return seconds[np.append(k, len(seconds) - 1)] if k[-1] < len(seconds) - 1 else seconds[k]


def usable(imu: ImuData, times: np.ndarray, max_gap: float) -> np.ndarray:
    """(n,) whether the IMU has readings at each time; gaps up to `max_gap` seconds count as readings."""
    inside = (times >= imu.seconds[0]) & (times <= imu.seconds[-1])
    return inside & clear_of((*_long_gaps(imu, max_gap), *imu.seams), times, times)


def _long_gaps(imu: ImuData, max_gap: float) -> list[tuple[float, float]]:
    return [(a, b) for a, b in imu.gaps if b - a > max_gap]
