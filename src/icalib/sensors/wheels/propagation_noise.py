"""What the IMU's noise adds to a relative pose of wheels whose ends lie beside the keyframes that they hang on.

Sideways such a pose may be good to 0.01 mm, as no wheel slips in (27). In 20 ms from a keyframe to an end the IMU loses
as much, and where that is not allowed for, the pose is believed more than it can be."""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import Poses


def carried_noise(
    first: Poses, last: Poses, away: np.ndarray, rotation: np.ndarray, lever: np.ndarray, imu: ImuData
) -> np.ndarray:
    """(n, 3, 3) covariance of yaw, x and y of the wheels over n stretches, where the IMU was carried over `away` (n, 2)
    s from the keyframes to the ends, `first` and `last`.

    Its orientation walks by the gyroscope's density g, turning the lever arm too, and its position by the
    accelerometer's a: g^2 t of each angle, a^2 t^3 / 3 of each axis. R_imu_wheel: `rotation`, p_imu_wheel: `lever`.
    """
    forth = np.swapaxes(first.rotation, 1, 2)
    between = forth @ last.rotation
    reached = np.einsum("nij,nj->ni", forth, last.position - first.position) + between @ lever
    turned = rotation.T @ so3.hat_many(reached), -rotation.T @ between @ so3.hat_many(lever)
    yaw = rotation.T[2]
    gyro, accel = np.median(imu.variance[:, :2], axis=0)
    out = np.zeros((len(away), 3, 3))
    for t, path, sign in zip(away.T, turned, (-1.0, 1.0), strict=True):
        rows = np.concatenate([np.broadcast_to(sign * yaw, (len(t), 1, 3)), path[:, :2]], axis=1)
        out += (gyro * t)[:, None, None] * rows @ np.swapaxes(rows, 1, 2)
        out += (accel * t**3 / 3.0)[:, None, None] * np.diag([0.0, 1.0, 1.0])
    return out
