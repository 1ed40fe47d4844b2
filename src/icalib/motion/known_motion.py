"""The IMU's motion once some sensors have shown it, for others to be placed on."""

from __future__ import annotations

import numpy as np

from icalib.motion.poses import Poses, assign_keyframes, poses_at
from icalib.motion.sweep import EstimatedMotion

MAX_KEYFRAME_DISTANCE_S = 0.15  # a scan of a LiDAR alone goes on so long after its keyframe


def are_near_keyframes(keyframes: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n,) whether there is a keyframe near each of the times (n,)."""
    k = np.clip(np.searchsorted(keyframes, times), 1, len(keyframes) - 1)
    return np.minimum(np.abs(times - keyframes[k - 1]), np.abs(times - keyframes[k])) < MAX_KEYFRAME_DISTANCE_S


def is_known(keyframes: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n,) whether the motion is known at times (n,) on the IMU's clock: between keyframes, and near one of them."""
    return are_near_keyframes(keyframes, times) & (times >= keyframes[0]) & (times <= keyframes[-1])


def imu_poses(motion: EstimatedMotion, times: np.ndarray) -> Poses:
    """The IMU's poses at times (n,) on its clock, by its readings from the keyframes next to them."""
    keyframe = assign_keyframes("inertial", motion.state.seconds, times)
    return poses_at("inertial", times, keyframe, motion.state, motion.imu, motion.gravity, False)
