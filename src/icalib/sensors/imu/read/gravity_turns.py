"""Gravity in the accelerometer's readings, from the IMU alone: it checks units and axes of gyroscope and accelerometer.

The gyroscope rotates the specific force of a short window into axes that do not rotate. Gravity is constant there, and
the mean of all other accelerations is small.
"""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import ImuStream
from icalib.geometry import so3

WINDOW_S, _RATE_HZ = 2.0, 100.0  # length of a window, and sampling rate within it
_MOST_WINDOWS = 64  # spread over the recording, from which the size of gravity is estimated


def gravity_spread(imu: ImuStream, unit: float) -> float | None:
    """RMS [m/s^2] of the specific force about its mean over two seconds, in axes that do not rotate.

    It is small if the gyroscope's readings times `unit` are the true rates [rad/s]. None for less than two seconds.
    """
    level = _level_force(imu, unit)
    if level is None:
        return None
    return float(np.sqrt(((level - level.mean(axis=1, keepdims=True)) ** 2).sum(axis=2).mean()))


def gravity_size(imu: ImuStream, unit: float) -> np.ndarray | None:
    """(n,) norm of the mean specific force over windows of two seconds, in axes that do not rotate.

    It is the size of gravity if the readings contain it and the gyroscope's readings times `unit` are the true rates
    [rad/s]. None for less than two seconds.
    """
    level = _level_force(imu, unit, _MOST_WINDOWS)
    return None if level is None else np.linalg.norm(level.mean(axis=1), axis=1)


def _level_force(imu: ImuStream, unit: float, most: int | None = None) -> np.ndarray | None:
    """Specific force (windows, n, 3) in the IMU axes of each window's first instant, for at most `most` windows.
    Windows without readings are left out. None for a recording shorter than one window."""
    t = imu.seconds
    count = int(WINDOW_S * _RATE_HZ)
    windows = np.unique((t[t < WINDOW_S * int(t[-1] / WINDOW_S)] / WINDOW_S).astype(np.int64))
    if not len(windows):
        return None
    if most is not None and len(windows) > most:
        windows = windows[np.linspace(0, len(windows) - 1, most).astype(int)]
    at = ((windows * count)[:, None] + np.arange(count)).ravel() / _RATE_HZ
    # The integral of the rates is interpolated, not the rates, so that no rotation between the instants is lost.
    angle = np.zeros((len(t), 3))
    angle[1:] = np.cumsum(0.5 * unit * (imu.gyro[1:] + imu.gyro[:-1]) * np.diff(t)[:, None], axis=0)
    turn, force = (
        np.stack([np.interp(at, t, x[:, k]) for k in range(3)], axis=1).reshape(len(windows), count, 3)
        for x in (angle, imu.accel)
    )
    R = np.tile(np.eye(3), (len(windows), 1, 1))
    level = np.empty_like(force)
    for k in range(count):
        level[:, k] = np.einsum("nij,nj->ni", R, force[:, k])
        if k + 1 < count:
            R = R @ so3.exp_many(np.ascontiguousarray(turn[:, k + 1] - turn[:, k]))
    return level
