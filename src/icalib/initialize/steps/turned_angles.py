"""Clocks of streams that are slow: a second between images or poses, in which the rate changes much.

The mean rate of an interval says little then, but how far was turned in it is known exactly, and so is how far the IMU
turned, whose rotations are chained over the interval. The two angles are the same, however the sensors stand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.motion.imu_data import ImuData, clear_of

OFFSET_GRID_S = 0.05  # between the offsets that are tried: short against the intervals
MAX_COMPARED_INTERVALS = 100  # that are compared at each offset
MIN_COVERED_SHARE = 0.5  # of the intervals that must lie within the IMU's recording
MIN_OFFSET_DISTANCE_S = 0.5  # of offsets that are two
MAX_ANGLE_OFFSETS = 5
SLOPE_STEP_S = 5e-3  # of the differences that give a slope
OFFSETS_PER_BATCH = 1000  # offsets at a time


@dataclass(frozen=True)
class ChainedRates:
    """The rotation vectors of an IMU over intervals, divided by their length: exact where mean rates are not."""

    turned: GyroRotation

    @classmethod
    def of(cls, imu: ImuData) -> ChainedRates:
        return cls(GyroRotation.integrate(imu, np.zeros(3)))

    def over(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """(n, 3) rad/s from start to end (n,) on the IMU's clock [s]."""
        a, b = self.turned.at(start), self.turned.at(end)
        return so3.log_many(np.ascontiguousarray(a.transpose(0, 2, 1) @ b)) / (end - start)[:, None]

    def slope(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """(n, 3) rad/s^2: how they change where both ends are later, by central differences."""
        return (
            self.over(start + SLOPE_STEP_S, end + SLOPE_STEP_S) - self.over(start - SLOPE_STEP_S, end - SLOPE_STEP_S)
        ) / (2.0 * SLOPE_STEP_S)


def offsets_by_angle(imu: ImuData, start: np.ndarray, end: np.ndarray, rate: np.ndarray) -> list[tuple[float, float]]:
    """Offsets [s] at which the angles turned between start and end (n,), rate (n, 3) times their length, are most like
    those of the IMU, the best first; and how much is left of the angles there, 0 to 1."""
    chosen = np.unique(np.linspace(0, len(start) - 1, min(len(start), MAX_COMPARED_INTERVALS)).astype(np.int64))
    start, end = start[chosen], end[chosen]
    angle = np.linalg.norm(rate[chosen], axis=1) * (end - start)
    turned = GyroRotation.integrate(imu, np.zeros(3))
    grid = np.arange(imu.seconds[0], imu.seconds[-1], OFFSET_GRID_S)
    R = turned.at(grid).reshape(-1, 9)
    begin, length = (np.round(x / OFFSET_GRID_S).astype(np.int64) for x in (start, end - start))
    known = clear_of(imu.gaps, grid, grid)
    unknown = np.concatenate([[0], np.cumsum(~known)])
    shifts = np.arange(-int(begin[-1]), len(grid))
    left = np.concatenate(
        [
            _angle_misfit(R, unknown, begin, length, angle, s)
            for s in np.array_split(shifts, 1 + len(shifts) // OFFSETS_PER_BATCH)
        ]
    )
    found: list[tuple[float, float]] = []
    apart = round(MIN_OFFSET_DISTANCE_S / OFFSET_GRID_S)
    for _ in range(MAX_ANGLE_OFFSETS):
        k = int(np.argmin(left))
        if not np.isfinite(left[k]):
            break
        found.append((float(shifts[k] * OFFSET_GRID_S + grid[0]), float(left[k])))
        left[max(k - apart, 0) : k + apart + 1] = np.inf
    return found


def _angle_misfit(
    R: np.ndarray, unknown: np.ndarray, begin: np.ndarray, length: np.ndarray, angle: np.ndarray, shifts: np.ndarray
) -> np.ndarray:
    """(m,) what is left of the angles (n,) at each of the shifts (m,), as a share of their spread; infinite where too
    few intervals lie within the grid of rotations R (k, 9), whose `unknown` (k + 1,) points are counted."""
    first = shifts[:, None] + begin
    last = first + length
    inside = (first >= 0) & (last < len(R))
    first, last = np.clip(first, 0, len(R) - 1), np.clip(last, 0, len(R) - 1)
    inside &= unknown[last] == unknown[first]
    cosine = 0.5 * (np.einsum("mni,mni->mn", R[first], R[last]) - 1.0)
    off = np.where(inside, np.arccos(np.clip(cosine, -1.0, 1.0)) - angle, 0.0)
    count = inside.sum(axis=1)
    mean = np.where(inside, angle, 0.0).sum(axis=1) / np.maximum(count, 1)
    spread = np.where(inside, (angle - mean[:, None]) ** 2, 0.0).sum(axis=1)
    return np.where(
        count >= MIN_COVERED_SHARE * len(angle), np.sqrt((off**2).sum(axis=1) / np.maximum(spread, 1e-12)), np.inf
    )
