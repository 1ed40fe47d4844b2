"""Angular rates of a camera from its poses, and the gyroscope's mean over the same intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.estimation.imu_data import ImuData
from icalib.geometry import so3
from icalib.initialization.guess import BoardPoses

# Between two images whose turn still tells of the rate in between; slow cameras leave no choice.
_LONGEST_S = 0.2
_LONGEST_SLOW_S = 0.5


@dataclass(frozen=True)
class CameraRates:
    """Mean angular rates over (t0, t1) [s, camera's relative clock]: rate (N, 3) rad/s in the camera frame."""

    t0: np.ndarray
    t1: np.ndarray
    rate: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        return 0.5 * (self.t0 + self.t1)

    @property
    def length(self) -> np.ndarray:
        return self.t1 - self.t0


def camera_rates(seconds: np.ndarray, poses: BoardPoses) -> CameraRates:
    """Rates between consecutive good images at most 0.2 s apart (0.5 s, if the camera is slow). seconds (M,)."""
    found = np.flatnonzero(poses.ok)
    first, second = found[:-1], found[1:]
    apart = seconds[second] - seconds[first]
    period = float(np.median(apart)) if len(apart) else 0.0
    near = apart < min(max(_LONGEST_S, 1.5 * period), _LONGEST_SLOW_S)
    first, second = first[near], second[near]
    turn = poses.R_board_cam[first].transpose(0, 2, 1) @ poses.R_board_cam[second]
    t0, t1 = seconds[first], seconds[second]
    return CameraRates(t0, t1, so3.log_many(np.ascontiguousarray(turn)) / (t1 - t0)[:, None])


class GyroMeans:
    """Means of the gyroscope over any interval: its readings, linear in between, integrated once."""

    def __init__(self, imu: ImuData) -> None:
        self._t, self._gyro = imu.seconds, imu.gyro
        step = np.diff(imu.seconds)[:, None]
        self._slope = np.diff(imu.gyro, axis=0) / step
        pieces = 0.5 * step * (imu.gyro[1:] + imu.gyro[:-1])
        self._integral = np.concatenate([np.zeros((1, 3)), np.cumsum(pieces, axis=0)])
        self._gaps = imu.gaps

    def mean(self, t0: np.ndarray, t1: np.ndarray) -> np.ndarray:
        """(N, 3) mean rate over each (t0, t1), imu clock."""
        return (self._integral_at(t1) - self._integral_at(t0)) / (t1 - t0)[:, None]

    def mean_slope(self, t0: np.ndarray, t1: np.ndarray) -> np.ndarray:
        """(N, 3) derivative of `mean` when both ends move together."""
        return (self._rate_at(t1) - self._rate_at(t0)) / (t1 - t0)[:, None]

    def covered(self, t0: np.ndarray, t1: np.ndarray) -> np.ndarray:
        """(N,) whether readings exist over the whole of each (t0, t1)."""
        inside = (t0 >= self._t[0]) & (t1 <= self._t[-1])
        for start, end in self._gaps:
            inside &= (t1 <= start) | (t0 >= end)
        return inside

    @property
    def duration(self) -> float:
        return float(self._t[-1])

    def _locate(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k = np.clip(np.searchsorted(self._t, t, side="right") - 1, 0, len(self._t) - 2)
        return k, (t - self._t[k])[:, None]

    def _rate_at(self, t: np.ndarray) -> np.ndarray:
        k, into = self._locate(t)
        return self._gyro[k] + into * self._slope[k]

    def _integral_at(self, t: np.ndarray) -> np.ndarray:
        k, into = self._locate(t)
        return self._integral[k] + into * (self._gyro[k] + 0.5 * into * self._slope[k])
