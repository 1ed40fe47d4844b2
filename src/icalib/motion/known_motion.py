"""The IMU's motion once some sensors have shown it, for others to be placed on."""

from __future__ import annotations

import numpy as np

from icalib.motion.poses import Poses, assign_nodes, poses_at
from icalib.motion.sweep import Motion

NEAR_NODE_S = 0.15  # a scan of a LiDAR alone goes on so long after its node


def near_nodes(nodes: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n,) whether there is a node near each of the times (n,)."""
    k = np.clip(np.searchsorted(nodes, times), 1, len(nodes) - 1)
    return np.minimum(np.abs(times - nodes[k - 1]), np.abs(times - nodes[k])) < NEAR_NODE_S


def is_known(nodes: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n,) whether the motion is known at times (n,) on the IMU's clock: between nodes, and near one of them."""
    return near_nodes(nodes, times) & (times >= nodes[0]) & (times <= nodes[-1])


def imu_poses(motion: Motion, times: np.ndarray) -> Poses:
    """The IMU's poses at times (n,) on its clock, by its readings from the nodes next to them."""
    node = assign_nodes("inertial", motion.state.seconds, times)
    return poses_at("inertial", times, node, motion.state, motion.imu, motion.gravity, False)
