"""Intervals between stamps over which a sensor that integrates (wheels, odometry) is compared with the motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.motion.imu_data import SAME_INSTANT_S, ImuData, clear_of

MAX_INTERVAL_S = 0.5  # the approximations within an interval hold up to this length


@dataclass(frozen=True)
class StampIntervals:
    """n intervals between stamps `first` and `last` (n,), indices of a sensor's stamps. The first stamp belongs to
    `keyframe` (n,), sorted, the last one to the next keyframe."""

    first: np.ndarray
    last: np.ndarray
    keyframe: np.ndarray


def choose_intervals(imu: ImuData, keyframes: np.ndarray, starts: tuple[int, ...], times: np.ndarray) -> StampIntervals:
    """Intervals between the stamps nearest to neighbouring keyframes; `times` (N,): stamps on the IMU clock.

    If keyframes are denser than stamps, neighbours may share a stamp. The interval to the next stamp then belongs to
    the two keyframes about its middle. No interval leaves the IMU's recording, touches a gap in it, or crosses the
    first keyframes `starts` of recordings. If motion is propagated forwards only (see `ImuData`), the stamp is the
    first after the keyframe.
    """
    after = np.clip(np.searchsorted(times, keyframes), 1, len(times) - 1)
    is_before = keyframes - times[after - 1] < times[after] - keyframes + SAME_INSTANT_S
    near = after if imu.forwards else after - is_before
    a, b = times[near[:-1]], times[near[1:]]
    good = (a < b) & _usable(imu, a, b)
    good[np.array(starts[1:], dtype=np.int64) - 1] = False
    keyframe = np.flatnonzero(good)
    return StampIntervals(near[keyframe], near[keyframe + 1], keyframe)


def pose_intervals(imu: ImuData, keyframes: np.ndarray, starts: tuple[int, ...], times: np.ndarray) -> StampIntervals:
    """All intervals between neighbouring stamps `times` (N,) on the IMU clock, each at the two keyframes about its
    middle. None leaves the IMU's recording, touches a gap in it, or lies beyond the keyframes or between recordings."""
    a, b = times[:-1], times[1:]
    middle = 0.5 * (a + b)
    good = _usable(imu, a, b) & (middle > keyframes[0]) & (middle < keyframes[-1])
    keyframe = np.searchsorted(keyframes, middle) - 1
    good &= ~np.isin(keyframe + 1, starts)
    k = np.flatnonzero(good)
    return StampIntervals(k, k + 1, keyframe[k])


def _usable(imu: ImuData, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(n,) whether each interval is short, and lies within one recording of the IMU and outside its gaps."""
    return (end - start <= MAX_INTERVAL_S) & imu.covers(start, end) & clear_of(imu.seams, start, end)
