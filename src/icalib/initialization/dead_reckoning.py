"""The IMU's readings integrated once over the whole recording, so that any stretch of it is a difference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from icalib.estimation.imu_data import ImuData
from icalib.geometry import so3


@dataclass(frozen=True)
class DeadReckoning:
    """Q = R_start_imu and the first and second time integrals of [Q a | Q] (3, 4), a the readings, at all stamps.

    The second column block is minus the derivative of the first with respect to the accelerometer bias.
    """

    seconds: np.ndarray  # (N,)
    gyro: np.ndarray  # (N, 3) bias removed
    rotation: np.ndarray  # (N, 3, 3)
    force: np.ndarray  # (N, 3, 4)
    first: np.ndarray  # (N, 3, 4)
    second: np.ndarray  # (N, 3, 4)
    gaps: tuple[tuple[float, float], ...]

    @classmethod
    def integrate(cls, imu: ImuData, gyro_bias: np.ndarray) -> DeadReckoning:
        gyro = imu.gyro - gyro_bias
        n = len(gyro)
        rotation, force = np.empty((n, 3, 3)), np.empty((n, 3, 4))
        first, second = np.zeros((n, 3, 4)), np.zeros((n, 3, 4))
        _integrate(imu.seconds, gyro, imu.accel, rotation, force, first, second)
        return cls(imu.seconds, gyro, rotation, force, first, second, imu.gaps)

    def unbroken(self, t0: np.ndarray, t1: np.ndarray) -> np.ndarray:
        """(n,) whether each (t0, t1) is free of gaps."""
        free = np.ones(len(t0), dtype=np.bool_)
        for start, end in self.gaps:
            free &= (t1 <= start) | (t0 >= end)
        return free

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Q (n, 3, 3), first and second integral (n, 3, 4) at t (n,) on the imu clock; outside, the ends go on."""
        n = len(t)
        Q, first, second = np.empty((n, 3, 3)), np.empty((n, 3, 4)), np.empty((n, 3, 4))
        k = np.clip(np.searchsorted(self.seconds, t, side="right") - 1, 0, len(self.seconds) - 2)
        _sample(t, k, self.seconds, self.gyro, self.rotation, self.force, self.first, self.second, Q, first, second)
        return Q, first, second


@njit(cache=True, nogil=True)
def _turn(Q, phi, out):
    """out = Q Exp(phi)."""
    E = so3.exp(phi)
    for i in range(3):
        for j in range(3):
            out[i, j] = Q[i, 0] * E[0, j] + Q[i, 1] * E[1, j] + Q[i, 2] * E[2, j]


@njit(cache=True, nogil=True)
def _integrate(t, gyro, accel, rotation, force, first, second):
    """Rates by midpoint, forces linear between readings."""
    rotation[0] = np.eye(3)
    phi = np.empty(3)
    for k in range(len(t)):
        if k > 0:
            dt = t[k] - t[k - 1]
            for i in range(3):
                phi[i] = 0.5 * dt * (gyro[k - 1, i] + gyro[k, i])
            _turn(rotation[k - 1], phi, rotation[k])
        for i in range(3):
            force[k, i, 0] = 0.0
            for j in range(3):
                force[k, i, 0] += rotation[k, i, j] * accel[k, j]
                force[k, i, 1 + j] = rotation[k, i, j]
        if k > 0:
            for i in range(3):
                for j in range(4):
                    a, b = force[k - 1, i, j], force[k, i, j]
                    first[k, i, j] = first[k - 1, i, j] + 0.5 * dt * (a + b)
                    second[k, i, j] = second[k - 1, i, j] + dt * (first[k - 1, i, j] + dt * (2.0 * a + b) / 6.0)


@njit(cache=True, nogil=True)
def _sample(t, interval, seconds, gyro, rotation, force, first, second, Q, first_at, second_at):
    phi = np.empty(3)
    for n in range(len(t)):
        k = interval[n]
        dt, into = seconds[k + 1] - seconds[k], t[n] - seconds[k]
        for i in range(3):
            phi[i] = into * (gyro[k, i] + 0.5 * into / dt * (gyro[k + 1, i] - gyro[k, i]))
        _turn(rotation[k], phi, Q[n])
        for i in range(3):
            for j in range(4):
                a, slope = force[k, i, j], (force[k + 1, i, j] - force[k, i, j]) / dt
                first_at[n, i, j] = first[k, i, j] + into * (a + 0.5 * into * slope)
                second_at[n, i, j] = second[k, i, j] + into * (first[k, i, j] + into * (0.5 * a + into * slope / 6.0))
