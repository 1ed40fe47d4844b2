"""Propagated IMU noise in recorded relative poses of wheels whose end points lie between keyframes.

The pose of each end point is propagated by the IMU from its keyframe. The lateral noise of relative poses by equation
(27) of the iCalib paper is tiny, as its model has no slip: 0.01 mm, as much as 20 ms of propagation. The noise of a
relative pose therefore includes that of the propagation.
"""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3
from icalib.motion.imu_data import ImuData
from icalib.motion.pose_rows import Extrinsics
from icalib.motion.poses import Poses


def propagation_noise(
    first: Poses, last: Poses, propagated: np.ndarray, wheels: Extrinsics, imu: ImuData
) -> np.ndarray:
    """Covariance (n, 3, 3) of yaw, x and y [rad, m, m] of n relative poses due to the noise of the IMU.

    first, last: poses of the IMU at both ends; propagated (n, 2): propagation time [s] from keyframe to each end.
    wheels: their extrinsics. With the noise densities g and a of gyroscope and accelerometer, the variance after t
    seconds is g^2 t for each angle and a^2 t^3 / 3 for each axis of position. Errors of the angles also rotate the
    lever arm.
    """
    R, p = wheels.R, wheels.p
    R_first_world = np.swapaxes(first.rotation, 1, 2)
    R_first_last = R_first_world @ last.rotation
    end = np.einsum("nij,nj->ni", R_first_world, last.position - first.position) + R_first_last @ p
    J_position_rotation = R.T @ so3.hat_many(end), -R.T @ R_first_last @ so3.hat_many(p)
    yaw = R.T[2]
    gyro, accel = np.median(imu.variance[:, :2], axis=0)
    out = np.zeros((len(propagated), 3, 3))
    for t, J_position, sign in zip(propagated.T, J_position_rotation, (-1.0, 1.0), strict=True):
        J = np.concatenate([np.broadcast_to(sign * yaw, (len(t), 1, 3)), J_position[:, :2]], axis=1)
        out += (gyro * t)[:, None, None] * J @ np.swapaxes(J, 1, 2)
        out += (accel * t**3 / 3.0)[:, None, None] * np.diag([0.0, 1.0, 1.0])
    return out
