"""Pose of one sensor relative to another, with its uncertainty from the joint covariance of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from icalib.result.calibration import Calibration, ParameterGroup


@dataclass(frozen=True)
class RelativePose:
    """T_frame_sensor (4, 4): p_frame = T p_sensor. covariance (6, 6): rotation [rad] about the sensor's axes (right
    perturbation), translation [m] along the frame's, empirical factors included. As an array it is T."""

    frame: str
    sensor: str
    T: np.ndarray
    covariance: np.ndarray

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.T, dtype=dtype)

    @property
    def name(self) -> str:
        return f"T_{self.frame}_{self.sensor}"

    @property
    def std(self) -> np.ndarray:
        """(6,) rotation, translation."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def distance(self) -> float:
        """m, between the origins of both: the baseline of a pair of cameras."""
        return float(np.linalg.norm(self.T[:3, 3]))

    @property
    def distance_std(self) -> float:
        """m, to first order; the largest of any direction where both are at one place."""
        covariance = self.covariance[3:, 3:]
        if self.distance == 0.0:
            return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        along = self.T[:3, 3] / self.distance
        return float(np.sqrt(along @ covariance @ along))


def relative_poses(c: Calibration) -> tuple[RelativePose, ...]:
    """Relative poses of all pairs of mounted sensors; of one kind only cameras are paired."""
    kinds = {name: sensor["type"] for name, sensor in c.rig["sensors"].items()}
    pairs = list(combinations(c.cameras, 2))
    pairs += [(a, b) for a, b in combinations(c.mounted, 2) if kinds[a] != kinds[b]]
    return tuple(relative_pose(c, frame, sensor) for frame, sensor in pairs)


def relative_pose(c: Calibration, frame: str, sensor: str) -> RelativePose:
    """Pose of `sensor` in the frame of another sensor; either may be the IMU. Raises KeyError naming what there is."""
    T = np.linalg.inv(_pose(c, frame)) @ _pose(c, sensor)
    J = relative_jacobian(c, frame, sensor)
    return RelativePose(frame, sensor, T, J @ _joint_covariance(c, frame, sensor) @ J.T)


def relative_jacobian(c: Calibration, frame: str, sensor: str) -> np.ndarray:
    """(6, 12) of T_frame_sensor by rotation and translation of both sensors.

    With T_imu_frame = (R, p), T_imu_sensor = (Q, q) and the relative pose (S, s) = (R^T Q, R^T (q - p)), perturbations
    dR, dQ on the right, dp and dq give dS = dQ - S^T dR on the right and ds = R^T (dq - dp) + s x dR.
    """
    T_imu_frame = _pose(c, frame)
    T = np.linalg.inv(T_imu_frame) @ _pose(c, sensor)
    R, S, s = T_imu_frame[:3, :3], T[:3, :3], T[:3, 3]
    J = np.zeros((6, 12))
    J[:3, :3], J[:3, 6:9] = -S.T, np.eye(3)
    J[3:, :3] = [[0.0, -s[2], s[1]], [s[2], 0.0, -s[0]], [-s[1], s[0], 0.0]]
    J[3:, 3:6], J[3:, 9:] = -R.T, R.T
    return J


def _joint_covariance(c: Calibration, *sensors: str) -> np.ndarray:
    """(6 n, 6 n) of rotation and translation of each of n sensors, empirical factors included; 0 where fixed."""
    return joint_covariance(c, [g for sensor in sensors for g in pose_groups(c, sensor)], 3)


def _pose(c: Calibration, sensor: str) -> np.ndarray:
    return np.eye(4) if pose_groups(c, sensor)[1] is None else c.T_imu_sensor(sensor)


def pose_groups(c: Calibration, sensor: str) -> tuple[ParameterGroup | None, ParameterGroup | None]:
    """Rotation and translation of `sensor`; None of what is exactly known: of the IMU where poses are relative to it,
    and the rotation of a sensor that has none."""
    known = {g.name: g for g in c.groups if g.sensor == sensor}
    if sensor == c.imu and "rotation" not in known:
        return None, None
    return c.group_or_none(sensor, "rotation"), c.group(sensor, "translation")


def joint_covariance(c: Calibration, groups: Sequence[ParameterGroup | None], none: int = 0) -> np.ndarray:
    """(n, n) covariance of all entries of `groups`, one after the other, empirical factors included; 0 if fixed. A None
    in place of a group stands for `none` exactly known entries."""
    sizes = [none if g is None else len(g.labels) for g in groups]
    out, at, columns, scale = np.zeros((sum(sizes),) * 2), [], [], []
    for k, g in enumerate(groups):
        if g is not None and g.columns is not None:
            first = sum(sizes[:k])
            at += range(first, first + sizes[k])
            columns += g.columns
            scale += [1.0] * sizes[k] if g.factor is None else np.maximum(g.factor, 1.0).tolist()
    out[np.ix_(at, at)] = c.covariance[np.ix_(columns, columns)] * np.outer(scale, scale)
    return out
