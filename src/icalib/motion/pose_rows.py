"""Residuals of poses that a sensor reports, with Jacobians by the pose of the sensor (`sensor_pose`) and by the
reference frame.

Rotation: e = Log(measured^T predicted). Position: predicted - measured, in the axes of the measurement. Rotations are
perturbed on the right, so de = J_r^-1(e) d for a factor on the right of the prediction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3


@dataclass(frozen=True)
class Extrinsics:
    """R_imu_sensor (3, 3), p_imu_sensor (3,) m; or the pose of a sensor in the frame of another one."""

    R: np.ndarray
    p: np.ndarray


@dataclass(frozen=True)
class Frame:
    """Pose of a reference frame: R_world_frame (3, 3), p_world_frame (3,) m."""

    R: np.ndarray
    p: np.ndarray


@dataclass(frozen=True)
class PoseResiduals:
    """n poses of 6 rows, rotation and position, not whitened. residual (n, 6); J_pose: (n, 6, 6) by the sensor's pose,
    for relative poses one for each end; J_frame (n, 6, 6 or 0): by R_world_frame, p_world_frame. Jacobians have length
    0 if not wanted."""

    residual: np.ndarray
    J_pose: tuple[np.ndarray, ...]
    J_frame: np.ndarray

    @classmethod
    def alone(cls, residual: np.ndarray) -> PoseResiduals:
        """Residuals (n, 6) without Jacobians."""
        nothing = np.zeros((0, 6, 6))
        return cls(residual, (nothing, nothing), nothing)


def absolute_residuals(
    R: np.ndarray, p: np.ndarray, frame: Frame, rotation: np.ndarray, position: np.ndarray, jacobians: bool = True
) -> PoseResiduals:
    """Residuals of measured poses R_frame_sensor `rotation` (n, 3, 3), p_frame_sensor `position` (n, 3). R (n, 3, 3), p
    (n, 3): predicted poses of the sensor in the world.

        Log(rotation^T R_world_frame^T R),  R_world_frame^T (p - p_world_frame) - position
    """
    n, predicted = len(R), frame.R.T @ R
    e = so3.log_many(np.ascontiguousarray(_t(rotation) @ predicted))
    x = (p - frame.p) @ frame.R
    residual = np.concatenate([e, x - position], axis=1)
    if not jacobians:
        return PoseResiduals.alone(residual)
    J = right_jacobians_inverse(e)
    J_pose, J_frame = np.zeros((n, 6, 6)), np.zeros((n, 6, 6))
    J_pose[:, :3, :3] = J
    J_pose[:, 3:, 3:] = predicted
    J_frame[:, :3, :3] = -J @ _t(predicted)
    J_frame[:, 3:, :3] = so3.hat_many(x)
    J_frame[:, 3:, 3:] = -frame.R.T
    return PoseResiduals(residual, (J_pose,), J_frame)


def relative_residuals(
    R: tuple[np.ndarray, np.ndarray],
    p: tuple[np.ndarray, np.ndarray],
    rotation: np.ndarray,
    position: np.ndarray,
    jacobians: bool = True,
) -> PoseResiduals:
    """Residuals of measured poses `rotation` (n, 3, 3), `position` (n, 3) of the sensor at the later instant relative
    to the earlier. R[0], p[0] and R[1], p[1]: predicted poses at both.

        Log(rotation^T Q), Q = R_0^T R_1,  R_0^T (p_1 - p_0) - position
    """
    n, Q = len(R[0]), _t(R[0]) @ R[1]
    e = so3.log_many(np.ascontiguousarray(_t(rotation) @ Q))
    x = np.einsum("nji,nj->ni", R[0], p[1] - p[0])
    residual = np.concatenate([e, x - position], axis=1)
    if not jacobians:
        return PoseResiduals.alone(residual)
    J = right_jacobians_inverse(e)
    before, after = np.zeros((n, 6, 6)), np.zeros((n, 6, 6))
    before[:, :3, :3] = -J @ _t(Q)
    before[:, 3:, :3] = so3.hat_many(x)
    before[:, 3:, 3:] = -np.eye(3)
    after[:, :3, :3] = J
    after[:, 3:, 3:] = Q
    return PoseResiduals(residual, (before, after), np.zeros((n, 6, 0)))


@njit(cache=True, nogil=True)
def right_jacobians_inverse(e: np.ndarray) -> np.ndarray:
    """Inverse right Jacobians (n, 3, 3) at rotation vectors e (n, 3) rad."""
    out = np.empty((len(e), 3, 3))
    for i in range(len(e)):
        out[i] = so3.right_jacobian_inverse(e[i])
    return out


def _t(R: np.ndarray) -> np.ndarray:
    """Transposed matrices (..., 3, 3)."""
    return np.swapaxes(R, -1, -2)
