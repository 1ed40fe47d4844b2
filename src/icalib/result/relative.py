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
    """T_frame_sensor, T (4, 4): p_frame = T p_sensor. covariance (6, 6), empirical factors included: rotation [rad]
    about the sensor's axes (right perturbation), then translation [m] along the axes of `frame`. Converts to the array
    T."""

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
        """(6,) standard deviations: rotation about the sensor's axes [rad], translation along the axes of `frame`
        [m]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def distance(self) -> float:
        """Distance between the origins of both sensors [m], such as the baseline of a stereo pair."""
        return float(np.linalg.norm(self.T[:3, 3]))

    @property
    def distance_std(self) -> float:
        """Standard deviation of `distance` [m], to first order. If the distance is zero: the largest standard deviation
        of the translation over all directions."""
        covariance = self.covariance[3:, 3:]
        if self.distance == 0.0:
            return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        along = self.T[:3, 3] / self.distance
        return float(np.sqrt(along @ covariance @ along))


def relative_poses(c: Calibration) -> tuple[RelativePose, ...]:
    """Relative poses of all pairs of sensors with a lens, and of all pairs of mounted sensors of different types."""
    kinds = {name: sensor["type"] for name, sensor in c.rig["sensors"].items()}
    pairs = list(combinations(c.lenses, 2))
    pairs += [(a, b) for a, b in combinations(c.mounted, 2) if kinds[a] != kinds[b]]
    return tuple(relative_pose(c, frame, sensor) for frame, sensor in pairs)


def relative_pose(c: Calibration, frame: str, sensor: str) -> RelativePose:
    """Pose of `sensor` in the frame of the sensor `frame`; either may be the IMU. Raises KeyError, which lists the
    existing groups."""
    T = np.linalg.inv(_pose(c, frame)) @ _pose(c, sensor)
    J = relative_jacobian(c, frame, sensor)
    return RelativePose(frame, sensor, T, J @ _joint_covariance(c, frame, sensor) @ J.T)


def relative_jacobian(c: Calibration, frame: str, sensor: str) -> np.ndarray:
    """(6, 12) Jacobian of T_frame_sensor by rotation and translation of `frame`, then of `sensor`.

    With T_imu_frame = (R, p), T_imu_sensor = (Q, q) and the relative pose (S, s) = (R^T Q, R^T (q - p)), right
    perturbations dR, dQ and additive dp, dq give dS = dQ - S^T dR (right perturbation) and ds = R^T (dq - dp) + s x dR.
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
    """(6 n, 6 n) covariance of rotation and translation of each of n sensors, empirical factors included; zero if
    fixed."""
    return joint_covariance(c, [g for sensor in sensors for g in pose_groups(c, sensor)], 3)


def _pose(c: Calibration, sensor: str) -> np.ndarray:
    return np.eye(4) if pose_groups(c, sensor)[1] is None else c.T_imu_sensor(sensor)


def pose_groups(c: Calibration, sensor: str) -> tuple[ParameterGroup | None, ParameterGroup | None]:
    """Rotation and translation of `sensor`. None in place of a group that is exactly known: both of an IMU that is the
    reference, and the rotation of a sensor without a rotation."""
    known = {g.name: g for g in c.groups if g.sensor == sensor}
    if sensor == c.imu and "rotation" not in known:
        return None, None
    return c.group_or_none(sensor, "rotation"), c.group(sensor, "translation")


def joint_covariance(c: Calibration, groups: Sequence[ParameterGroup | None], none: int = 0) -> np.ndarray:
    """(n, n) covariance of all entries of `groups`, in their order, empirical factors included; zero if fixed. A None
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
