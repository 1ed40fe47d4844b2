"""A frame that reports its own relative planar poses (paper (27)): time offset by correlation, the rest linearly.

Over a short interval, with u and w the velocity and rate of the IMU in its own axes, r_k the axes of the frame there,

    yaw' = r_3 w        (x', y') = r_k u + (p_imu_wheel x r_k) w,  k = 1, 2
"""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import WheelPoses
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.motion.imu_data import ImuData
from icalib.motion.pose_rows import Extrinsics

GRID_HZ = 100.0
LEAST_EXPLAINED = 0.5  # of the variance of the yaw rate, by the gyroscope
WEAK = 0.02  # of the largest singular value: directions that move less say nothing
ROUNDS = 6
CANDIDATES = 30  # shifts that are tried in earnest


def yaw_rates(stream: WheelPoses) -> tuple[np.ndarray, np.ndarray]:
    """Middles (K,) of its intervals, seconds on its own clock, and mean yaw rates (K,) rad/s."""
    t = stream.seconds
    return 0.5 * (t[1:] + t[:-1]), stream.pose[:, 0] / np.diff(t)


def poses_offset(imu: ImuData, stream: WheelPoses) -> float:
    """Seconds to add to the clock of the frame to get the IMU's, both since their first stamps.

    Where the gyroscope's three axes together explain most of the yaw rate. Raises EstimationError where they do not at
    any shift.
    """
    middle, yaw = yaw_rates(stream)
    grid = np.arange(int(imu.seconds[-1] * GRID_HZ) + 1) / GRID_HZ
    own = np.arange(int(middle[0] * GRID_HZ), int(middle[-1] * GRID_HZ) + 1) / GRID_HZ
    gyro = np.stack([np.interp(grid, imu.seconds, g) for g in imu.gyro.T])
    turned = np.interp(own, middle, yaw)
    offset, explained = _best_shift(gyro - gyro.mean(axis=1, keepdims=True), turned - turned.mean())
    if explained < LEAST_EXPLAINED:
        raise EstimationError(
            f"the yaw rate of {stream.name} does not match that of {imu.name} at any time offset "
            f"({explained:.0%} of it explained); check that both come from the same recording, and turn more."
        )
    offset -= own[0]
    angle = np.zeros_like(imu.gyro)
    np.cumsum(0.5 * (imu.gyro[1:] + imu.gyro[:-1]) * np.diff(imu.seconds)[:, None], axis=0, out=angle[1:])
    for _ in range(ROUNDS):
        inside = intervals_inside(imu, stream, offset)
        start, end = (t[inside] + offset for t in (stream.seconds[:-1], stream.seconds[1:]))
        mean, slope = ((_at(end, imu, x) - _at(start, imu, x)) / (end - start)[:, None] for x in (angle, imu.gyro))
        A = np.column_stack([mean, np.ones(len(mean))])
        axis = _least_squares(A, yaw[inside])
        change = slope @ axis[:3]
        step = change @ (yaw[inside] - A @ axis) / max(change @ change, 1e-12)
        offset += float(np.clip(step, -0.02, 0.02))
    return offset


def _at(t: np.ndarray, imu: ImuData, x: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(t, imu.seconds, own) for own in x.T], axis=1)


def extrinsics_guess(stream: WheelPoses, inside: np.ndarray, rate: np.ndarray, velocity: np.ndarray) -> Extrinsics:
    """Extrinsics of the wheels from relative poses and the motion of the IMU.

    inside (K,): the intervals that are used, n; rate [rad/s], velocity [m/s] (n, 3): means over each of the IMU's, in
    its axes.
    """
    pose, dt = stream.pose[inside], np.diff(stream.seconds)[inside]
    half = 0.5 * pose[:, 0]
    c, s = np.cos(half), np.sin(half)
    x, y = c * pose[:, 1] + s * pose[:, 2], c * pose[:, 2] - s * pose[:, 1]  # as seen half-way
    up = _least_squares(np.column_stack([rate, np.ones(len(rate))]), pose[:, 0] / dt)[:3]
    moving = np.column_stack([velocity, rate])
    ahead, left = (_least_squares(moving, way / dt) for way in (x, y))
    R = so3.closest_rotation(np.stack([ahead[:3], left[:3], up]))
    rows = np.concatenate([-_cross(R[0]), -_cross(R[1])])  # p x r = -r x p
    return Extrinsics(R.T, _least_squares(rows, np.concatenate([ahead[3:], left[3:]])))


def _least_squares(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(A, b, rcond=WEAK)[0]


def _cross(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _best_shift(gyro: np.ndarray, yaw: np.ndarray) -> tuple[float, float]:
    """Seconds by which yaw (m,) is late against gyro (3, n), and the share of its variance that this explains."""
    n, m = gyro.shape[1], len(yaw)
    size = 1 << (n + m - 1).bit_length()
    product = np.fft.irfft(np.fft.rfft(gyro, size) * np.conj(np.fft.rfft(yaw, size)), size)
    lag = np.arange(-(m - 1), n)
    c = product[:, lag]
    count = np.minimum(n, lag + m) - np.maximum(0, lag)
    explained = np.einsum("kl,kl->l", c, np.linalg.pinv(gyro @ gyro.T / n, rcond=WEAK) @ c) / count
    likely = np.where(count >= 0.5 * min(n, m), explained / (count * yaw.var()), 0.0)
    peaks = np.flatnonzero((likely[1:-1] >= likely[:-2]) & (likely[1:-1] >= likely[2:])) + 1
    # The axes move with each other otherwise in one part of the recording than in all of it: the best peaks anew.
    best = max(peaks[np.argsort(-likely[peaks])[:CANDIDATES]], key=lambda k: _fit(gyro, yaw, int(lag[k])))
    return float(lag[best]) / GRID_HZ, _share(gyro, yaw, int(lag[best]))


def _share(gyro: np.ndarray, yaw: np.ndarray, lag: int) -> float:
    """Of the variance of yaw (m,), what gyro (3, n) explains where the two overlap, yaw late by `lag` samples."""
    a, b = max(0, -lag), min(len(yaw), gyro.shape[1] - lag)
    A, y = np.column_stack([gyro[:, a + lag : b + lag].T, np.ones(b - a)]), yaw[a:b]
    left = y - A @ _least_squares(A, y)
    return 1.0 - float(left.var() / max(y.var(), 1e-12))


def _fit(gyro: np.ndarray, yaw: np.ndarray, lag: int) -> float:
    """How sure a match is: a long overlap is."""
    count = min(len(yaw), gyro.shape[1] - lag) - max(0, -lag)
    return float(np.arctanh(np.sqrt(np.clip(_share(gyro, yaw, lag), 0.0, 0.999999))) * np.sqrt(count))


def intervals_inside(imu: ImuData, stream: WheelPoses, offset: float) -> np.ndarray:
    """(K,) intervals within the IMU's recording and none of its gaps."""
    return imu.covers(stream.seconds[:-1] + offset, stream.seconds[1:] + offset)
