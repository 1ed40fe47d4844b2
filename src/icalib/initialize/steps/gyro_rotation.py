"""Dead reckoning of rotation by the gyroscope, to carry poses from image instants to any other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.motion.imu_data import ImuData

SMOOTHING_HALF_WINDOW_S = 0.5  # to both sides: short against the drift of the gyroscope


@dataclass(frozen=True)
class GyroRotation:
    """R_start_imu (N, 3, 3) at every IMU stamp, integrated with a constant bias; rate (N - 1, 3) between stamps."""

    imu: ImuData
    rotation: np.ndarray
    rate: np.ndarray

    @classmethod
    def integrate(cls, imu: ImuData, bias: np.ndarray) -> GyroRotation:
        rate = 0.5 * (imu.gyro[1:] + imu.gyro[:-1]) - bias
        steps = so3.exp_many(rate * np.diff(imu.seconds)[:, None])
        rotation = np.empty((len(imu.seconds), 3, 3))
        rotation[0] = np.eye(3)
        so3.chain(steps, rotation)
        return cls(imu, rotation, rate)

    def at(self, t: np.ndarray) -> np.ndarray:
        """(n, 3, 3) R_start_imu at times t; beyond the recording the last rate is continued."""
        j = self.imu.interval(t)
        return self.rotation[j] @ so3.exp_many(self.rate[j] * (t - self.imu.seconds[j])[:, None])

    def carry(self, t: np.ndarray, rotation: np.ndarray, to: np.ndarray) -> np.ndarray:
        """(n, 3, 3) rotations at `to`, each from the nearest of the known `rotation` at times t (in order)."""
        after = np.clip(np.searchsorted(t, to), 1, len(t) - 1)
        near = after - (to - t[after - 1] < t[after] - to)
        start = self.at(t)[near]
        return rotation[near] @ start.transpose(0, 2, 1) @ self.at(to)

    def smoothed(self, t: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """(n, 3, 3) means of the R_any_imu that are known around times t (in order), carried by the gyroscope, and over
        no gap of it. Where rotations are coefficients of unknowns, their noise would pull these to zero."""
        turned = self.at(t)
        start = rotation @ turned.transpose(0, 2, 1)
        total = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(start, axis=0)])
        part = np.searchsorted([gap for gap, _ in self.imu.gaps], t)
        low = np.maximum(np.searchsorted(t, t - SMOOTHING_HALF_WINDOW_S), np.searchsorted(part, part))
        high = np.minimum(
            np.searchsorted(t, t + SMOOTHING_HALF_WINDOW_S, side="right"), np.searchsorted(part, part, side="right")
        )
        left, _, right = np.linalg.svd(total[high] - total[low])
        return left @ right @ turned
