"""Residuals of poses that a sensor reports, and their derivatives by the pose of the IMU (see `pose_factor`).

Rotations e = Log(measured^T predicted) are perturbed on the right, so de = J_r^-1(e) d of whatever stands on the right
of the prediction; positions are predicted - measured, in the axes in which they were measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3


@dataclass(frozen=True)
class Mount:
    """R_imu_sensor (3, 3), p_imu_sensor (3,) m."""

    R: np.ndarray
    p: np.ndarray


@dataclass(frozen=True)
class Frame:
    """R_world_frame (3, 3), p_world_frame (3,) m."""

    R: np.ndarray
    p: np.ndarray


@dataclass(frozen=True)
class PoseRows:
    """n poses of 6 rows, rotation and position, not whitened. residual (n, 6); J_pose (n, 6, 6) by rotation and
    position of the IMU, of relative poses one for each end; J_mount (n, 6, 6) by R_imu_sensor, p_imu_sensor; J_frame
    (n, 6, 6 or 0) by R_world_frame, p_world_frame. Jacobians of length 0 where they are not wanted."""

    residual: np.ndarray
    J_pose: tuple[np.ndarray, ...]
    J_mount: np.ndarray
    J_frame: np.ndarray

    @classmethod
    def alone(cls, residual: np.ndarray) -> PoseRows:
        """Residuals (n, 6) without Jacobians."""
        nothing = np.zeros((0, 6, 6))
        return cls(residual, (nothing, nothing), nothing, nothing)


def absolute_rows(
    R: np.ndarray,
    p: np.ndarray,
    mount: Mount,
    frame: Frame,
    rotation: np.ndarray,
    position: np.ndarray,
    jacobians: bool = True,
) -> PoseRows:
    """Of poses R_frame_sensor (n, 3, 3), p_frame_sensor (n, 3), while the IMU was at R (n, 3, 3), p (n, 3):

    Log(rotation^T R_world_frame^T R R_imu_sensor),  R_world_frame^T (p + R p_imu_sensor - p_world_frame) - position
    """
    n = len(R)
    in_frame = frame.R.T @ R  # R_frame_imu
    predicted = in_frame @ mount.R
    e = so3.log_many(np.ascontiguousarray(_t(rotation) @ predicted))
    x = (p + R @ mount.p - frame.p) @ frame.R
    residual = np.concatenate([e, x - position], axis=1)
    if not jacobians:
        return PoseRows.alone(residual)
    J = right_jacobians_inverse(e)
    J_pose, J_mount, J_frame = (np.zeros((n, 6, 6)) for _ in range(3))
    J_pose[:, :3, :3] = J @ mount.R.T
    J_pose[:, 3:, :3] = -in_frame @ so3.hat_many(mount.p)
    J_pose[:, 3:, 3:] = frame.R.T
    J_mount[:, :3, :3] = J
    J_mount[:, 3:, 3:] = in_frame
    J_frame[:, :3, :3] = -J @ _t(predicted)
    J_frame[:, 3:, :3] = so3.hat_many(x)
    J_frame[:, 3:, 3:] = -frame.R.T
    return PoseRows(residual, (J_pose,), J_mount, J_frame)


def relative_rows(
    R: tuple[np.ndarray, np.ndarray],
    p: tuple[np.ndarray, np.ndarray],
    mount: Mount,
    rotation: np.ndarray,
    position: np.ndarray,
    jacobians: bool = True,
) -> PoseRows:
    """Of poses (n, 3, 3), (n, 3) of the sensor at the later of two instants, seen from the earlier, while the IMU was
    at R[0], p[0] and R[1], p[1]:

    Log(rotation^T Q),  Q = R_imu_sensor^T R_0^T R_1 R_imu_sensor
    R_imu_sensor^T (R_0^T (p_1 + R_1 p_imu_sensor - p_0) - p_imu_sensor) - position
    """
    n, turn = len(R[0]), _t(R[0]) @ R[1]
    Q = mount.R.T @ turn @ mount.R
    e = so3.log_many(np.ascontiguousarray(_t(rotation) @ Q))
    way = np.einsum("nji,nj->ni", R[0], p[1] + R[1] @ mount.p - p[0])
    x = (way - mount.p) @ mount.R
    residual = np.concatenate([e, x - position], axis=1)
    if not jacobians:
        return PoseRows.alone(residual)
    J = right_jacobians_inverse(e)
    before, after, J_mount = (np.zeros((n, 6, 6)) for _ in range(3))
    before[:, :3, :3] = -J @ mount.R.T @ _t(turn)
    before[:, 3:, :3] = mount.R.T @ so3.hat_many(way)
    before[:, 3:, 3:] = -mount.R.T @ _t(R[0])
    after[:, :3, :3] = J @ mount.R.T
    after[:, 3:, :3] = -mount.R.T @ turn @ so3.hat_many(mount.p)
    after[:, 3:, 3:] = mount.R.T @ _t(R[0])
    J_mount[:, :3, :3] = J @ (np.eye(3) - _t(Q))
    J_mount[:, 3:, :3] = so3.hat_many(x)
    J_mount[:, 3:, 3:] = mount.R.T @ (turn - np.eye(3))
    return PoseRows(residual, (before, after), J_mount, np.zeros((n, 6, 0)))


@njit(cache=True, nogil=True)
def right_jacobians_inverse(e: np.ndarray) -> np.ndarray:
    """(n, 3, 3) J_r^-1 at rotation vectors e (n, 3) rad."""
    out = np.empty((len(e), 3, 3))
    for i in range(len(e)):
        out[i] = so3.right_jacobian_inverse(e[i])
    return out


@njit(cache=True, nogil=True)
def add_chain_rule(J_pose, at, out_node, out_time, out_imu):
    """Adds the derivatives of rows through a pose of the IMU, J_pose (n, 6, 6), `at` of which are the `Poses`: by the
    node to out_node (n, 6, 15), by time to out_time (n, 6), by the IMU intrinsics to out_imu (n, 6, 24 or 0)."""
    J_node, J_imu, rate, velocity = at
    for i in range(len(J_pose)):
        for q in range(6):
            for k in range(6):
                f = J_pose[i, q, k]
                if f == 0.0:
                    continue
                out_time[i, q] += f * (rate[i, k] if k < 3 else velocity[i, k - 3])
                for c in range(15):
                    out_node[i, q, c] += f * J_node[i, k, c]
                for c in range(out_imu.shape[2]):
                    out_imu[i, q, c] += f * J_imu[i, k, c]


def _t(R: np.ndarray) -> np.ndarray:
    return np.swapaxes(R, -1, -2)
