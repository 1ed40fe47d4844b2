"""How far a result is from the truth, in the perturbations that its covariance is of."""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3
from icalib.geometry.targets.base import BOARD
from icalib.tools.simulation import Truth


def true_value(truth: Truth, sensor: str, name: str) -> np.ndarray | None:
    """The truth of the group `name` of `sensor`, in the form of `ParameterGroup.value`; None where none is stated, as
    of a target's tilt."""
    poses = truth.T_imu_cam | truth.T_imu_lidar | truth.T_imu_wheel | truth.T_imu_pose
    if (sensor, name) == ("imu0", "intrinsics"):
        return truth.imu_intrinsics
    if (sensor, name) == (BOARD, "size"):
        return np.array([truth.target_size])
    if sensor not in poses:
        return None
    if name == "rotation":
        return poses[sensor][:3, :3]
    if name == "translation":
        return poses[sensor][:3, 3]
    found = getattr(truth, name, {}).get(sensor, truth.drive.get(sensor, {}).get(name))
    return None if found is None else np.atleast_1d(np.asarray(found, dtype=np.float64))


def error(name: str, value: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(n,) estimated minus true; of rotations e of R_estimated = R_true Exp(e), in the sensor's axes."""
    return so3.log(np.ascontiguousarray(true.T @ value)) if name == "rotation" else value - true
