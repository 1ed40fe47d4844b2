"""Trajectory of the IMU, from the poses of a sensor on it and from the IMU's readings in between.

Rotations come from the sensor, interpolated by the gyroscope. With known gravity and accelerometer bias, positions p_k
and velocities v_k at the poses k follow by linear least squares, independently for each axis, from

    p_k+1 = p_k + v_k h + g h^2 / 2 + dp_k        v_k+1 = v_k + g h + dv_k        p_k = measured position

with interval h, gravity g, and the double and single integrals dp_k, dv_k of the specific force in world axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry.integrals import once_integrated
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.motion.imu_data import ImuData, clear_of

SENSOR_POSITION_SIGMA_M = 0.02  # m: standard deviation of the sensor's positions
IMU_DISPLACEMENT_SIGMA_M = 2e-3  # m: of a displacement by the IMU between two poses, without gap
IMU_VELOCITY_SIGMA_M_S = 0.02  # m/s: of a change of velocity by the IMU between two poses, without gap
IMU_GAP_SIGMA_FACTOR = 1e4  # factor on both standard deviations of the IMU over a gap: practically no constraint
MAX_PROPAGATION_S = 1.0  # s: longer intervals between poses count as gaps


@dataclass(frozen=True)
class SignalIntegrals:
    """First and second integrals over time, from the first stamp, of a signal x (N, m) that is linear between the IMU's
    stamps. once, twice (N, m): at these stamps."""

    imu: ImuData
    x: np.ndarray
    once: np.ndarray
    twice: np.ndarray

    @classmethod
    def of(cls, imu: ImuData, x: np.ndarray) -> SignalIntegrals:
        """Integrates the signal x (N, m), given at the stamps of `imu`."""
        h = np.diff(imu.seconds)[:, None]
        once, twice = once_integrated(x, h[:, 0]), np.zeros_like(x)
        twice[1:] = np.cumsum(h * once[:-1] + h**2 * (x[:-1] / 3.0 + x[1:] / 6.0), axis=0)
        return cls(imu, x, once, twice)

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First and second integral (n, m) at times t (n,) s. Outside the recording the signal is extrapolated
        linearly."""
        j = self.imu.interval(t)
        s, h = (t - self.imu.seconds[j])[:, None], np.diff(self.imu.seconds)[j][:, None]
        slope = (self.x[j + 1] - self.x[j]) / h
        once = self.once[j] + self.x[j] * s + 0.5 * slope * s**2
        return once, self.twice[j] + self.once[j] * s + 0.5 * self.x[j] * s**2 + slope * s**3 / 6.0


@dataclass(frozen=True)
class ImuTrajectory:
    """The IMU in a world with z up, at increasing seconds (n,): R_world_imu (n, 3, 3), position (n, 3) m, velocity
    (n, 3) m/s. gyro_bias (3,) rad/s, accel_bias (3,) m/s^2; gravity: magnitude [m/s^2]."""

    gyro: GyroRotation
    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    gravity: float

    @property
    def bias(self) -> np.ndarray:
        """(6,) biases of gyroscope [rad/s] and accelerometer [m/s^2]."""
        return np.concatenate([self.gyro_bias, self.accel_bias])

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R_world_imu (n, 3, 3), position (n, 3) m and velocity (n, 3) m/s at times t (n,) s on the IMU's clock,
        propagated by its readings from the last instant before."""
        down = np.array([0.0, 0.0, -self.gravity])
        force = self._force_integrals()
        k = np.clip(np.searchsorted(self.seconds, t, side="right") - 1, 0, len(self.seconds) - 1)
        once, twice = force.at(t)
        once_k, twice_k = (x[k] for x in force.at(self.seconds))
        h = (t - self.seconds[k])[:, None]
        velocity = self.velocity[k] + h * down + once - once_k
        position = self.position[k] + h * self.velocity[k] + 0.5 * h**2 * down + twice - twice_k - h * once_k
        return self.gyro.carry(self.seconds, self.rotation, t), position, velocity

    def _force_integrals(self) -> SignalIntegrals:
        """Integrals of the specific force in world axes, without bias."""
        imu = self.gyro.imu
        R = self.gyro.carry(self.seconds, self.rotation, imu.seconds)
        return SignalIntegrals.of(imu, np.einsum("nij,nj->ni", R, imu.accel - self.accel_bias))

    def smoothed(self) -> ImuTrajectory:
        """The trajectory with positions smoothed, and velocities estimated, by the IMU's readings between the poses."""
        down, t = np.array([0.0, 0.0, -self.gravity]), self.seconds
        once, twice = self._force_integrals().at(t)
        h = np.diff(t)[:, None]
        velocity_change = np.diff(once, axis=0) + h * down
        displacement = np.diff(twice, axis=0) - h * once[:-1] + 0.5 * h**2 * down
        has_gap = (h[:, 0] > MAX_PROPAGATION_S) | ~clear_of(self.gyro.imu.gaps, t[:-1], t[1:])
        position, velocity = _least_squares(
            h[:, 0], self.position, displacement, velocity_change, np.where(has_gap, IMU_GAP_SIGMA_FACTOR, 1.0)
        )
        return ImuTrajectory(
            self.gyro, t, self.rotation, position, velocity, self.gyro_bias, self.accel_bias, self.gravity
        )


def _least_squares(
    h: np.ndarray,
    positions: np.ndarray,
    displacement: np.ndarray,
    velocity_change: np.ndarray,
    sigma_factor: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (n, 3) from measured positions (n, 3), and increments of position and velocity (n -
    1, 3) over intervals h (n - 1,) s, whose standard deviations are scaled by sigma_factor (n - 1,)."""
    n = len(positions)
    D, U, r = np.zeros((n, 2, 2)), np.zeros((n - 1, 2, 2)), np.zeros((n, 2, 3))
    D[:, 0, 0] = SENSOR_POSITION_SIGMA_M**-2
    r[:, 0] = positions * SENSOR_POSITION_SIGMA_M**-2
    # Rows B x_k+1 + A x_k = (displacement, velocity_change) of x = (position, velocity).
    A, B = np.zeros((n - 1, 2, 2)), np.tile(np.eye(2), (n - 1, 1, 1))
    A[:, 0, 0] = A[:, 1, 1] = -1.0
    A[:, 0, 1] = -h
    w = np.stack(
        [(IMU_DISPLACEMENT_SIGMA_M * sigma_factor) ** -2, (IMU_VELOCITY_SIGMA_M_S * sigma_factor) ** -2], axis=1
    )
    b = np.stack([displacement, velocity_change], axis=1)
    At, Bt = A.transpose(0, 2, 1) * w[:, None, :], B.transpose(0, 2, 1) * w[:, None, :]
    D[:-1] += At @ A
    D[1:] += Bt @ B
    U[:] = At @ B
    r[:-1] += At @ b
    r[1:] += Bt @ b
    x = _solve_block_tridiagonal(D, U, r)
    return x[:, 0], x[:, 1]


def _solve_block_tridiagonal(D: np.ndarray, U: np.ndarray, r: np.ndarray) -> np.ndarray:
    """x (n, 2, 3) of the symmetric system with diagonal blocks D (n, 2, 2), blocks U (n - 1, 2, 2) above them and right
    sides r (n, 2, 3), by block elimination. D and r are overwritten."""
    n = len(D)
    for k in range(1, n):
        F = np.linalg.solve(D[k - 1], U[k - 1]).T
        D[k] -= F @ U[k - 1]
        r[k] -= F @ r[k - 1]
    x = np.empty((n, 2, 3))
    x[-1] = np.linalg.solve(D[-1], r[-1])
    for k in range(n - 2, -1, -1):
        x[k] = np.linalg.solve(D[k], r[k] - U[k] @ x[k + 1])
    return x
