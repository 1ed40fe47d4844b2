"""Between which stamps what a sensor integrates, turns of wheels or odometry, is compared with the motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.motion.imu_data import ImuData, clear_of

MAX_INTERVAL_S = 0.5  # intervals longer than this are no longer consistent


@dataclass(frozen=True)
class StampIntervals:
    """n stretches between stamps `first` and `last` (n,) of a sensor. The first end hangs on `keyframe` (n,), in order,
    the last one on the keyframe after it."""

    first: np.ndarray
    last: np.ndarray
    keyframe: np.ndarray


def choose_intervals(imu: ImuData, keyframes: np.ndarray, starts: tuple[int, ...], times: np.ndarray) -> StampIntervals:
    """Stretches from the stamp nearest to a keyframe to the one nearest to the next; `times` (N,): stamps on the imu
    clock.

    Where keyframes are denser than stamps, neighbours may share a stamp; the stretch to the next stamp then hangs on
    the two keyframes about its middle. None leaves the IMU's recording, touches a gap in it, or goes from one of the
    recordings that begin at the keyframes `starts` to another. Where motion is carried forwards only (see `ImuData`),
    the stamp is the first after the keyframe.
    """
    after = np.clip(np.searchsorted(times, keyframes), 1, len(times) - 1)
    near = after if imu.forwards else after - (keyframes - times[after - 1] < times[after] - keyframes)
    a, b = times[near[:-1]], times[near[1:]]
    good = (a < b) & _usable(imu, a, b)
    good[np.array(starts[1:], dtype=np.int64) - 1] = False
    keyframe = np.flatnonzero(good)
    return StampIntervals(near[keyframe], near[keyframe + 1], keyframe)


def pose_intervals(imu: ImuData, keyframes: np.ndarray, starts: tuple[int, ...], times: np.ndarray) -> StampIntervals:
    """All stretches from one stamp to the next, each on the two keyframes about its middle; `times` (N,): stamps on the
    imu clock. None leaves the IMU's recording, touches a gap in it, or lies beyond the keyframes or between
    recordings."""
    a, b = times[:-1], times[1:]
    middle = 0.5 * (a + b)
    good = _usable(imu, a, b) & (middle > keyframes[0]) & (middle < keyframes[-1])
    keyframe = np.searchsorted(keyframes, middle) - 1
    good &= ~np.isin(keyframe + 1, starts)
    k = np.flatnonzero(good)
    return StampIntervals(k, k + 1, keyframe[k])


def _usable(imu: ImuData, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(n,) whether each span is short, and lies within the IMU's recordings and none of their gaps."""
    return (end - start <= MAX_INTERVAL_S) & imu.covers(start, end) & clear_of(imu.seams, start, end)
