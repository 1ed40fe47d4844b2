"""How the IMU moved while a LiDAR looked around: the LiDAR's positions, with the IMU's readings in between.

Rotations come from the LiDAR, carried by the gyroscope. With gravity and the accelerometer's bias known, positions and
velocities at the scans are linear least squares, each axis on its own:

    p_k+1 = p_k + v_k h + g h^2 / 2 + dp_k        v_k+1 = v_k + g h + dv_k        p_k as the LiDAR shows it
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.motion.imu_data import ImuData, clear_of

SENSOR_POSITION_SIGMA_M, IMU_DISPLACEMENT_SIGMA_M, IMU_VELOCITY_SIGMA_M_S = (
    0.02,
    2e-3,
    0.02,
)  # m, m, m/s: of what the LiDAR shows, of what the IMU feels
IMU_GAP_SIGMA_FACTOR = 1e4  # times as much where the IMU did not run
MAX_PROPAGATION_S = 1.0


@dataclass(frozen=True)
class SignalIntegrals:
    """First and second integrals over time of a signal x (N, m) that is linear between the IMU's stamps, from the first
    stamp on."""

    imu: ImuData
    x: np.ndarray
    once: np.ndarray
    twice: np.ndarray

    @classmethod
    def of(cls, imu: ImuData, x: np.ndarray) -> SignalIntegrals:
        h = np.diff(imu.seconds)[:, None]
        once, twice = np.zeros_like(x), np.zeros_like(x)
        once[1:] = np.cumsum(0.5 * h * (x[1:] + x[:-1]), axis=0)
        twice[1:] = np.cumsum(h * once[:-1] + h**2 * (x[:-1] / 3.0 + x[1:] / 6.0), axis=0)
        return cls(imu, x, once, twice)

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both (n, m) at times t; beyond the recording the last signal is continued."""
        j = self.imu.interval(t)
        s, h = (t - self.imu.seconds[j])[:, None], np.diff(self.imu.seconds)[j][:, None]
        slope = (self.x[j + 1] - self.x[j]) / h
        once = self.once[j] + self.x[j] * s + 0.5 * slope * s**2
        return once, self.twice[j] + self.once[j] * s + 0.5 * self.x[j] * s**2 + slope * s**3 / 6.0


@dataclass(frozen=True)
class ImuTrajectory:
    """The IMU in a world with z up. At instants seconds (n,), in order: R_world_imu, position and velocity; gyro_bias,
    accel_bias (3,); gravity: how long it is [m/s^2]."""

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
        """(6,) gyroscope, accelerometer."""
        return np.concatenate([self.gyro_bias, self.accel_bias])

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R_world_imu (n, 3, 3), position and velocity (n, 3) at times t on the imu clock, from the instant before."""
        down = np.array([0.0, 0.0, -self.gravity])
        felt = self._felt()
        k = np.clip(np.searchsorted(self.seconds, t, side="right") - 1, 0, len(self.seconds) - 1)
        once, twice = felt.at(t)
        once_k, twice_k = (x[k] for x in felt.at(self.seconds))
        h = (t - self.seconds[k])[:, None]
        velocity = self.velocity[k] + h * down + once - once_k
        position = self.position[k] + h * self.velocity[k] + 0.5 * h**2 * down + twice - twice_k - h * once_k
        return self.gyro.carry(self.seconds, self.rotation, t), position, velocity

    def _felt(self) -> SignalIntegrals:
        """Integrals of the accelerometer's readings in world axes."""
        imu = self.gyro.imu
        R = self.gyro.carry(self.seconds, self.rotation, imu.seconds)
        return SignalIntegrals.of(imu, np.einsum("nij,nj->ni", R, imu.accel - self.accel_bias))

    def smoothed(self) -> ImuTrajectory:
        """Positions made better and velocities found by what the IMU feels between them."""
        down, t = np.array([0.0, 0.0, -self.gravity]), self.seconds
        once, twice = self._felt().at(t)
        h = np.diff(t)[:, None]
        speed = np.diff(once, axis=0) + h * down
        way = np.diff(twice, axis=0) - h * once[:-1] + 0.5 * h**2 * down
        unfelt = (h[:, 0] > MAX_PROPAGATION_S) | ~clear_of(self.gyro.imu.gaps, t[:-1], t[1:])
        position, velocity = _least_squares(
            h[:, 0], self.position, way, speed, np.where(unfelt, IMU_GAP_SIGMA_FACTOR, 1.0)
        )
        return ImuTrajectory(
            self.gyro, t, self.rotation, position, velocity, self.gyro_bias, self.accel_bias, self.gravity
        )


def _least_squares(
    h: np.ndarray, seen: np.ndarray, way: np.ndarray, speed: np.ndarray, rough: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (n, 3) from seen (n, 3) positions, and steps (n - 1, 3) way and speed over h (n - 1,),
    whose sigma is `rough` times as much; block tridiagonal."""
    n = len(seen)
    D, U, r = np.zeros((n, 2, 2)), np.zeros((n - 1, 2, 2)), np.zeros((n, 2, 3))
    D[:, 0, 0] = SENSOR_POSITION_SIGMA_M**-2
    r[:, 0] = seen * SENSOR_POSITION_SIGMA_M**-2
    A, B = np.zeros((n - 1, 2, 2)), np.tile(np.eye(2), (n - 1, 1, 1))  # rows B x_k+1 + A x_k = (way, speed)
    A[:, 0, 0] = A[:, 1, 1] = -1.0
    A[:, 0, 1] = -h
    w = np.stack([(IMU_DISPLACEMENT_SIGMA_M * rough) ** -2, (IMU_VELOCITY_SIGMA_M_S * rough) ** -2], axis=1)
    b = np.stack([way, speed], axis=1)
    At, Bt = A.transpose(0, 2, 1) * w[:, None, :], B.transpose(0, 2, 1) * w[:, None, :]
    D[:-1] += At @ A
    D[1:] += Bt @ B
    U[:] = At @ B
    r[:-1] += At @ b
    r[1:] += Bt @ b
    for k in range(1, n):
        F = np.linalg.solve(D[k - 1], U[k - 1]).T
        D[k] -= F @ U[k - 1]
        r[k] -= F @ r[k - 1]
    x = np.empty((n, 2, 3))
    x[-1] = np.linalg.solve(D[-1], r[-1])
    for k in range(n - 2, -1, -1):
        x[k] = np.linalg.solve(D[k], r[k] - U[k] @ x[k + 1])
    return x[:, 0], x[:, 1]
