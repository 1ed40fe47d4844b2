"""Motion of the IMU that is already estimated, for aligning further sensors to it."""

from __future__ import annotations

import numpy as np

from icalib.motion.poses import Poses, assign_keyframes, poses_at
from icalib.motion.sweep import EstimatedMotion

MAX_KEYFRAME_DISTANCE_S = 0.15  # covers a LiDAR scan of 10 Hz whose keyframe is at its start


def are_near_keyframes(keyframes: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n,) whether there is a keyframe within MAX_KEYFRAME_DISTANCE_S of each time (n,)."""
    k = np.clip(np.searchsorted(keyframes, times), 1, len(keyframes) - 1)
    return np.minimum(np.abs(times - keyframes[k - 1]), np.abs(times - keyframes[k])) < MAX_KEYFRAME_DISTANCE_S


def is_known(keyframes: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n,) whether the motion is known at each time (n,) on the IMU clock: between keyframes and near one of them."""
    return are_near_keyframes(keyframes, times) & (times >= keyframes[0]) & (times <= keyframes[-1])


def imu_poses(motion: EstimatedMotion, times: np.ndarray) -> Poses:
    """Poses of the IMU at times (n,) on its clock, integrated from the nearest keyframes."""
    keyframe = assign_keyframes("inertial", motion.state.seconds, times)
    return poses_at("inertial", times, keyframe, motion.state, motion.imu, motion.gravity, False)
