"""Initial guess of wheels that report relative planar poses (equation (27) of the iCalib paper).

The time offset follows from correlation, the extrinsics from linear least squares. Over a short interval, with u and w
the velocity and rate of the IMU in its own axes, and r_k the columns of R_imu_wheel,

    yaw' = r_3 w        (x', y') = r_k u + (p_imu_wheel x r_k) w,  k = 1, 2
"""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import WheelPoses
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.motion.imu_data import ImuData
from icalib.motion.pose_rows import Extrinsics

CORRELATION_HZ = 100.0  # grid of the correlation; Gauss-Newton refines its peak
MIN_EXPLAINED = 0.5  # least share of the variance of the yaw rate that the gyroscope explains at the right offset
MIN_SINGULAR_RATIO = 0.02  # relative to the largest singular value; smaller ones are noise and are truncated
MAX_REFINEMENTS = 6  # Gauss-Newton steps of the time offset
OFFSET_STEP_S = 0.02  # largest of these steps: two samples of the grid
N_PEAKS = 30  # peaks of the correlation that are compared by the data in their overlap


def yaw_rates(stream: WheelPoses) -> tuple[np.ndarray, np.ndarray]:
    """Midpoints (K,) [s] of the intervals on the clock of the stream, and mean yaw rates (K,) [rad/s] over the
    intervals."""
    t = stream.seconds
    return 0.5 * (t[1:] + t[:-1]), stream.pose[:, 0] / np.diff(t)


def poses_offset(imu: ImuData, stream: WheelPoses) -> float:
    """Time offset [s] to add to the clock of the wheels to get the clock of the IMU, both since their first stamp.

    At this offset a linear combination of the gyroscope's axes explains the yaw rate best. Raises EstimationError if
    less than MIN_EXPLAINED of its variance is explained.
    """
    middle, yaw = yaw_rates(stream)
    grid = np.arange(int(imu.seconds[-1] * CORRELATION_HZ) + 1) / CORRELATION_HZ
    wheel_grid = np.arange(int(middle[0] * CORRELATION_HZ), int(middle[-1] * CORRELATION_HZ) + 1) / CORRELATION_HZ
    gyro = np.stack([np.interp(grid, imu.seconds, g) for g in imu.gyro.T])
    turned = np.interp(wheel_grid, middle, yaw)
    offset, explained = _best_shift(gyro - gyro.mean(axis=1, keepdims=True), turned - turned.mean())
    if explained < MIN_EXPLAINED:
        raise EstimationError(
            f"the yaw rate of {stream.name} does not match that of {imu.name} at any time offset "
            f"({explained:.0%} of it explained); check that both come from the same recording, and turn more."
        )
    offset -= wheel_grid[0]
    angle = np.zeros_like(imu.gyro)
    np.cumsum(0.5 * (imu.gyro[1:] + imu.gyro[:-1]) * np.diff(imu.seconds)[:, None], axis=0, out=angle[1:])
    for _ in range(MAX_REFINEMENTS):
        inside = intervals_inside(imu, stream, offset)
        start, end = (t[inside] + offset for t in (stream.seconds[:-1], stream.seconds[1:]))
        mean, slope = ((_at(end, imu, x) - _at(start, imu, x)) / (end - start)[:, None] for x in (angle, imu.gyro))
        A = np.column_stack([mean, np.ones(len(mean))])
        axis = _least_squares(A, yaw[inside])
        change = slope @ axis[:3]
        step = change @ (yaw[inside] - A @ axis) / max(change @ change, 1e-12)
        offset += float(np.clip(step, -OFFSET_STEP_S, OFFSET_STEP_S))
    return offset


def _at(t: np.ndarray, imu: ImuData, x: np.ndarray) -> np.ndarray:
    """x (N, 3), given at the stamps of the IMU, interpolated at t (n,) [s]; returns (n, 3)."""
    return np.stack([np.interp(t, imu.seconds, column) for column in x.T], axis=1)


def extrinsics_guess(stream: WheelPoses, inside: np.ndarray, rate: np.ndarray, velocity: np.ndarray) -> Extrinsics:
    """Extrinsics of the wheels from relative poses and the motion of the IMU.

    inside (K,) bool: the n intervals that are used. rate [rad/s], velocity [m/s] (n, 3): means over each interval for
    the IMU, in IMU axes.
    """
    pose, dt = stream.pose[inside], np.diff(stream.seconds)[inside]
    half = 0.5 * pose[:, 0]
    c, s = np.cos(half), np.sin(half)
    x, y = c * pose[:, 1] + s * pose[:, 2], c * pose[:, 2] - s * pose[:, 1]  # in axes at half the yaw
    up = _least_squares(np.column_stack([rate, np.ones(len(rate))]), pose[:, 0] / dt)[:3]
    moving = np.column_stack([velocity, rate])
    ahead, left = (_least_squares(moving, displacement / dt) for displacement in (x, y))
    R = so3.closest_rotation(np.stack([ahead[:3], left[:3], up]))
    rows = np.concatenate([-_cross(R[0]), -_cross(R[1])])  # p x r = -r x p
    return Extrinsics(R.T, _least_squares(rows, np.concatenate([ahead[3:], left[3:]])))


def _least_squares(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Minimum-norm solution x (k,) of A x = b with singular values below MIN_SINGULAR_RATIO truncated."""
    return np.linalg.lstsq(A, b, rcond=MIN_SINGULAR_RATIO)[0]


def _cross(v: np.ndarray) -> np.ndarray:
    """The cross-product matrix (3, 3) of v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _best_shift(gyro: np.ndarray, yaw: np.ndarray) -> tuple[float, float]:
    """Offset [s] of yaw rates (m,) against gyro (3, n), both on the grid, and the explained share of the variance of
    yaw rates."""
    n, m = gyro.shape[1], len(yaw)
    size = 1 << (n + m - 1).bit_length()
    product = np.fft.irfft(np.fft.rfft(gyro, size) * np.conj(np.fft.rfft(yaw, size)), size)
    lag = np.arange(-(m - 1), n)
    c = product[:, lag]
    count = np.minimum(n, lag + m) - np.maximum(0, lag)
    explained = np.einsum("kl,kl->l", c, np.linalg.pinv(gyro @ gyro.T / n, rcond=MIN_SINGULAR_RATIO) @ c) / count
    likely = np.where(count >= 0.5 * min(n, m), explained / (count * yaw.var()), 0.0)
    peaks = np.flatnonzero((likely[1:-1] >= likely[:-2]) & (likely[1:-1] >= likely[2:])) + 1
    # The correlation uses the covariance of the gyroscope over the recording; peaks are compared by that of the
    # overlap.
    best = max(peaks[np.argsort(-likely[peaks])[:N_PEAKS]], key=lambda k: _significance(gyro, yaw, int(lag[k])))
    return float(lag[best]) / CORRELATION_HZ, _explained(gyro, yaw, int(lag[best]))


def _explained(gyro: np.ndarray, yaw: np.ndarray, lag: int) -> float:
    """Share of the variance of yaw rates (m,) that gyro (3, n) explains in the overlap, `lag` samples apart."""
    a, b = max(0, -lag), min(len(yaw), gyro.shape[1] - lag)
    A, y = np.column_stack([gyro[:, a + lag : b + lag].T, np.ones(b - a)]), yaw[a:b]
    left = y - A @ _least_squares(A, y)
    return 1.0 - float(left.var() / max(y.var(), 1e-12))


def _significance(gyro: np.ndarray, yaw: np.ndarray, lag: int) -> float:
    """The correlation at `lag` as Fisher's z times the square root of the overlap: significance in standard
    deviations."""
    count = min(len(yaw), gyro.shape[1] - lag) - max(0, -lag)
    return float(np.arctanh(np.sqrt(np.clip(_explained(gyro, yaw, lag), 0.0, 0.999999))) * np.sqrt(count))


def intervals_inside(imu: ImuData, stream: WheelPoses, offset: float) -> np.ndarray:
    """(K,) bool: the interval lies within the recording of the IMU and outside its gaps. offset: time offset [s]."""
    return imu.covers(stream.seconds[:-1] + offset, stream.seconds[1:] + offset)
