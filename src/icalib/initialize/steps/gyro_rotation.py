"""Rotation by integrating the gyroscope, which interpolates between rotations that are known at some instants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.motion.imu_data import SAME_INSTANT_S, ImuData

SMOOTHING_HALF_WINDOW_S = 0.5  # s on both sides of an instant: the gyroscope drifts little over it


@dataclass(frozen=True)
class GyroRotation:
    """Rotations R_start_imu (N, 3, 3) at the stamps of the IMU; `start` is the IMU's frame at the first stamp. rate (N
    - 1, 3) rad/s: mean rate between stamps, without the bias."""

    imu: ImuData
    rotation: np.ndarray
    rate: np.ndarray

    @classmethod
    def integrate(cls, imu: ImuData, bias: np.ndarray) -> GyroRotation:
        """Integrates the readings with a constant `bias` (3,) rad/s, by the trapezoidal rule between stamps."""
        rate = 0.5 * (imu.gyro[1:] + imu.gyro[:-1]) - bias
        steps = so3.exp_many(rate * np.diff(imu.seconds)[:, None])
        rotation = np.empty((len(imu.seconds), 3, 3))
        rotation[0] = np.eye(3)
        so3.chain(steps, rotation)
        return cls(imu, rotation, rate)

    def at(self, t: np.ndarray) -> np.ndarray:
        """R_start_imu (n, 3, 3) at times t (n,) s. Outside the recording the first or last rate is extrapolated."""
        j = self.imu.interval(t)
        return self.rotation[j] @ so3.exp_many(self.rate[j] * (t - self.imu.seconds[j])[:, None])

    def carry(self, t: np.ndarray, rotation: np.ndarray, to: np.ndarray) -> np.ndarray:
        """Rotations R_any_imu (n, 3, 3) at times `to` (n,) s, from known ones (m, 3, 3) at increasing t (m,) s. Each is
        propagated from the nearest known one by the gyroscope."""
        after = np.clip(np.searchsorted(t, to), 1, len(t) - 1)
        near = after - (to - t[after - 1] < t[after] - to + SAME_INSTANT_S)
        start = self.at(t)[near]
        return rotation[near] @ start.transpose(0, 2, 1) @ self.at(to)

    def smoothed(self, t: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """The rotations R_any_imu (n, 3, 3) at increasing t (n,), with less noise: means of those within
        SMOOTHING_HALF_WINDOW_S, carried to t by the gyroscope. No mean spans a gap of the IMU.

        Use them where rotations are coefficients of unknowns: noise in coefficients biases least squares towards zero
        (errors in variables).
        """
        R_start_imu = self.at(t)
        start = rotation @ R_start_imu.transpose(0, 2, 1)
        total = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(start, axis=0)])
        part = np.searchsorted([gap for gap, _ in self.imu.gaps], t)
        half = SMOOTHING_HALF_WINDOW_S + SAME_INSTANT_S
        low = np.maximum(np.searchsorted(t, t - half), np.searchsorted(part, part))
        high = np.minimum(np.searchsorted(t, t + half), np.searchsorted(part, part, side="right"))
        U, _, Vt = np.linalg.svd(total[high] - total[low])
        return U @ Vt @ R_start_imu
