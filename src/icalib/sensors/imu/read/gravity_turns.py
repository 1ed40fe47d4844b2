"""Does gravity turn in the accelerometer as the gyroscope says? Told without any other sensor.

Seen from axes that the gyroscope keeps from turning, the specific force of a short window is gravity, which stands
still, and accelerations, whose mean is small.
"""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import ImuStream
from icalib.geometry import so3

WINDOW_S, _RATE_HZ = 2.0, 100.0  # over which gravity must stand still; how often it is looked at
_MOST_WINDOWS = 64  # that show the size of gravity, spread over the recording


def gravity_spread(imu: ImuStream, unit: float) -> float | None:
    """RMS [m/s^2] of the specific force about its mean over two seconds, seen from axes that do not turn: small where
    the rates, times `unit` [rad/s], turn as the IMU did. None for less than two seconds.
    """
    level = _level_force(imu, unit)
    if level is None:
        return None
    return float(np.sqrt(((level - level.mean(axis=1, keepdims=True)) ** 2).sum(axis=2).mean()))


def gravity_size(imu: ImuStream, unit: float) -> np.ndarray | None:
    """(n,) size of the mean specific force of windows of two seconds, seen from axes that do not turn: gravity, where
    it is in the readings and the rates are in `unit` [rad/s]. None for less than two seconds."""
    level = _level_force(imu, unit, _MOST_WINDOWS)
    return None if level is None else np.linalg.norm(level.mean(axis=1), axis=1)


def _level_force(imu: ImuStream, unit: float, most: int | None = None) -> np.ndarray | None:
    """(windows, n, 3) specific force in the axes of each window's first instant, of at most `most` windows; those
    without readings are left out. None for less than one window."""
    t = imu.seconds
    count = int(WINDOW_S * _RATE_HZ)
    own = np.unique((t[t < WINDOW_S * int(t[-1] / WINDOW_S)] / WINDOW_S).astype(np.int64))
    if not len(own):
        return None
    if most is not None and len(own) > most:
        own = own[np.linspace(0, len(own) - 1, most).astype(int)]
    at = ((own * count)[:, None] + np.arange(count)).ravel() / _RATE_HZ
    # Of the integral, so that no rotation is lost between the instants.
    angle = np.zeros((len(t), 3))
    angle[1:] = np.cumsum(0.5 * unit * (imu.gyro[1:] + imu.gyro[:-1]) * np.diff(t)[:, None], axis=0)
    turn, force = (
        np.stack([np.interp(at, t, x[:, k]) for k in range(3)], axis=1).reshape(len(own), count, 3)
        for x in (angle, imu.accel)
    )
    R = np.tile(np.eye(3), (len(own), 1, 1))
    level = np.empty_like(force)
    for k in range(count):
        level[:, k] = np.einsum("nij,nj->ni", R, force[:, k])
        if k + 1 < count:
            R = R @ so3.exp_many(np.ascontiguousarray(turn[:, k + 1] - turn[:, k]))
    return level
