"""Rotation by integrating the gyroscope, which interpolates between rotations that are known at some instants.

Time offset of a slow stream: images or poses up to 2 s apart, between which the angular rate changes much.

The mean rate of such an interval says little. The rotation angle over it is exact, though, and so is the angle that the
gyroscope integrates to. Both angles are equal, whatever the extrinsics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.motion.imu_data import SAME_INSTANT_S, ImuData, clear_of

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


OFFSET_GRID_S = 0.05  # s between offsets that are compared: short against the intervals
MAX_COMPARED_INTERVALS = 100  # intervals compared at each offset: more do not change which offset is best
MIN_COVERED_SHARE = 0.5  # share of the intervals that the IMU's recording must cover
MIN_OFFSET_DISTANCE_S = 0.5  # s between two candidate offsets
MAX_ANGLE_OFFSETS = 5  # candidate offsets, at most
SLOPE_STEP_S = 5e-3  # s: step of the central differences
OFFSETS_PER_BATCH = 1000  # offsets compared at once: bounds the memory


@dataclass(frozen=True)
class ChainedRates:
    """Rotation vectors of an IMU over intervals, divided by their length: exact also where the axis changes within an
    interval."""

    rotation: GyroRotation

    @classmethod
    def of(cls, imu: ImuData) -> ChainedRates:
        """Integrates the readings of `imu`, without a bias."""
        return cls(GyroRotation.integrate(imu, np.zeros(3)))

    def over(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Rates (n, 3) rad/s over intervals from start to end (n,), in s on the IMU's clock."""
        a, b = self.rotation.at(start), self.rotation.at(end)
        return so3.log_many(np.ascontiguousarray(a.transpose(0, 2, 1) @ b)) / (end - start)[:, None]

    def slope(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Derivatives (n, 3) rad/s^2 of the rates by a common shift of start and end, by central differences."""
        return (
            self.over(start + SLOPE_STEP_S, end + SLOPE_STEP_S) - self.over(start - SLOPE_STEP_S, end - SLOPE_STEP_S)
        ) / (2.0 * SLOPE_STEP_S)


def offsets_by_angle(imu: ImuData, start: np.ndarray, end: np.ndarray, rate: np.ndarray) -> list[tuple[float, float]]:
    """Time offsets [s] at which rotation angles over intervals match those of the IMU, the best first. Each comes with
    its misfit: RMS difference over the spread of the angles.

    start, end (n,): of the intervals [s]; rate (n, 3): rotation vectors over the length of the interval [rad/s].
    """
    chosen = np.unique(np.linspace(0, len(start) - 1, min(len(start), MAX_COMPARED_INTERVALS)).astype(np.int64))
    start, end = start[chosen], end[chosen]
    angle = np.linalg.norm(rate[chosen], axis=1) * (end - start)
    rotation = GyroRotation.integrate(imu, np.zeros(3))
    grid = np.arange(imu.seconds[0], imu.seconds[-1], OFFSET_GRID_S)
    R = rotation.at(grid).reshape(-1, 9)
    begin, length = (np.round(x / OFFSET_GRID_S).astype(np.int64) for x in (start, end - start))
    known = clear_of(imu.gaps, grid, grid)
    unknown = np.concatenate([[0], np.cumsum(~known)])
    shifts = np.arange(-int(begin[-1]), len(grid))
    misfit = np.concatenate(
        [
            _angle_misfit(R, unknown, begin, length, angle, s)
            for s in np.array_split(shifts, 1 + len(shifts) // OFFSETS_PER_BATCH)
        ]
    )
    offsets: list[tuple[float, float]] = []
    apart = round(MIN_OFFSET_DISTANCE_S / OFFSET_GRID_S)
    for _ in range(MAX_ANGLE_OFFSETS):
        k = int(np.argmin(misfit))
        if not np.isfinite(misfit[k]):
            break
        offsets.append((float(shifts[k] * OFFSET_GRID_S + grid[0]), float(misfit[k])))
        misfit[max(k - apart, 0) : k + apart + 1] = np.inf
    return offsets


def _angle_misfit(
    R: np.ndarray, unknown: np.ndarray, begin: np.ndarray, length: np.ndarray, angle: np.ndarray, shifts: np.ndarray
) -> np.ndarray:
    """(m,) misfit of angles (n,) at each of the shifts (m,), in steps of the grid; infinite if too few intervals are
    covered. R (k, 9): rotations on the grid; unknown (k + 1,): cumulative count of grid points in gaps; begin, length
    (n,): of the intervals, in steps."""
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
