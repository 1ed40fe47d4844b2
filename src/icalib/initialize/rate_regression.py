"""Time offset between a sensor and the IMU, by regression of the gyroscope on the sensor's angular rates.

    w_imu = M w_sensor + b

M (3, 3) is free, so neither the rotation between both sensors nor the scale of the rates must be known; b absorbs
the gyroscope's bias. The offset is the shift with the largest logarithm of the likelihood ratio, -n/2 log(1 - R^2).

Mean angular rate of an IMU over the intervals between images or poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry.small import MEDIAN_NORM, once_integrated
from icalib.initialize.rate_correlation import (
    MAX_OFFSET_PEAKS,
    MIN_PEAK_DISTANCE_S,
    MIN_RATE_OVERLAP_S,
    SensorRates,
    interpolated,
)
from icalib.motion.imu_data import ImuData, clear_of

# Logarithm of the likelihood ratio above which a match is significant. Without a match, twice the score is chi^2 with
# nine degrees of freedom, for 3 x 3 coefficients; it exceeds 30 at a given shift with a probability of 4e-4.
MIN_REGRESSION_SCORE = 15.0
MIN_RATE_TO_NOISE = 3.0  # variation of rates over their noise: below, a match may not be significant
GRID_POINTS_PER_INTERVAL = 10  # offsets are found to a twentieth of an interval
# Share of the mean square rate that is added about each axis: without it, rotation about one axis is singular
REGULARISING_SPREAD = 1e-3


@dataclass(frozen=True)
class Regression:
    """offset: t_imu - t_sensor [s], both since their clocks' first stamps; score: logarithm of the likelihood ratio,
    where the number of samples is that of non-overlapping intervals."""

    offset: float
    score: float


def best_regressions(imu: ImuData, rates: SensorRates) -> list[Regression]:
    """Regressions at the best shifts, the best first; empty if the recordings overlap at none. Samples in gaps are left
    out."""
    length = float(np.median(rates.end - rates.start))
    step = length / GRID_POINTS_PER_INTERVAL
    middle = 0.5 * (rates.start + rates.end)
    sensor, sensor_mask = _on_grid(middle - middle[0], rates.rate, np.diff(middle) < rates.longest_step_s, step)
    start = np.arange(0.0, imu.seconds[-1] - length, step)
    gyro, gyro_mask = MeanRates.of(imu).over(start, start + length), clear_of(imu.gaps, start, start + length)
    if not gyro_mask.any() or not sensor_mask.any():
        return []
    explained, count = _explained_share(gyro, gyro_mask, sensor, sensor_mask)
    enough = count > min(MIN_RATE_OVERLAP_S / step, 0.5 * min(gyro_mask.sum(), sensor_mask.sum()))
    score = np.where(
        enough, -0.5 * count / GRID_POINTS_PER_INTERVAL * np.log(1.0 - np.minimum(explained, 1.0 - 1e-9)), -np.inf
    )
    peaks: list[Regression] = []
    apart = round(MIN_PEAK_DISTANCE_S / step)
    while len(peaks) < MAX_OFFSET_PEAKS and np.isfinite(score).any():
        k = int(np.argmax(score))
        peaks.append(Regression((k - (len(sensor) - 1)) * step + 0.5 * length - float(middle[0]), float(score[k])))
        score[max(k - apart, 0) : k + apart + 1] = -np.inf
    return peaks


def rate_difference_noise(imu: ImuData, rates: SensorRates, averaged: float = 0.0) -> float:
    """Standard deviation [rad/s] of the difference between sensor and gyroscope rates about each axis, for means over
    `averaged` s if that is longer than an interval. Zero if the noise of the sensor's rates is unknown."""
    if not rates.noise:
        return 0.0
    length = float(np.median(rates.end - rates.start))
    variance = rates.noise**2 + float(np.median(imu.variance[:, 0])) / length
    return float(np.sqrt(variance * min(1.0, length / averaged if averaged else 1.0)))


def no_match_error(imu: ImuData, name: str, rates: SensorRates) -> EstimationError:
    """The error if no shift gives a significant regression: the rig turns too slowly, or the recordings differ."""
    length = float(np.median(rates.end - rates.start))
    start = np.arange(0.0, imu.seconds[-1] - length, length / GRID_POINTS_PER_INTERVAL)
    gyro = MeanRates.of(imu).over(start, start + length)
    variation = float(np.median(np.linalg.norm(gyro - np.median(gyro, axis=0), axis=1))) / MEDIAN_NORM
    if variation < MIN_RATE_TO_NOISE * rate_difference_noise(imu, rates):
        return EstimationError(
            f"{imu.name} and {name} turn too slowly or too steadily for a time offset: the angular rate varies "
            f"by {np.rad2deg(variation):.2g} deg/s, and the images show it to {np.rad2deg(rates.noise):.2g} "
            "deg/s. Turn the rig faster, back and forth about all axes, or give rotation and time_offset in "
            "the rig file."
        )
    return EstimationError(
        f"the motion of {name} does not match that of {imu.name} at any time offset; check that both come "
        "from the same recording and overlap in time."
    )


def _on_grid(t: np.ndarray, rate: np.ndarray, near: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Rates (n, 3) at increasing t (n,), interpolated on a grid of `step` s from 0; and a mask: between neighbours
    whose step is `near` (n - 1,)."""
    grid = np.arange(int(t[-1] / step) + 1) * step
    mask = near[np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(near) - 1)]
    return np.stack([np.interp(grid, t, rate[:, k]) for k in range(3)], axis=1), mask


def _explained_share(
    a: np.ndarray, mask_a: np.ndarray, b: np.ndarray, mask_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """R^2 of the regression of a (n, 3) on b (m, 3), at shifts of b by -(m - 1) to n - 1 samples, and the number of
    samples that are known in both; each (n + m - 1,). By FFT, as in masked cross-correlation."""
    n = len(a) + len(b) - 1
    size = 1 << (n - 1).bit_length()

    def transformed(x: np.ndarray) -> np.ndarray:
        return np.fft.rfft(x, size, axis=0)

    def correlated(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        product = np.fft.irfft(x * np.conj(y), size)
        return np.concatenate([product[size - (len(b) - 1) :], product[: len(a)]])

    a, b = a * mask_a[:, None], b * mask_b[:, None]
    ma, mb, fa, fb = (transformed(x) for x in (mask_a.astype(float), mask_b.astype(float), a, b))
    count = np.maximum(correlated(ma, mb), 1e-9)
    sa, sb = (
        np.stack([correlated(*p) for p in pairs], axis=1)
        for pairs in ([(fa[:, k], mb) for k in range(3)], [(ma, fb[:, k]) for k in range(3)])
    )
    cross_covariance, auto_covariance = np.empty((n, 3, 3)), np.empty((n, 3, 3))
    for i in range(3):
        for j in range(3):
            cross_covariance[:, i, j] = correlated(fa[:, i], fb[:, j]) - sa[:, i] * sb[:, j] / count
            auto_covariance[:, i, j] = correlated(ma, transformed(b[:, i] * b[:, j])) - sb[:, i] * sb[:, j] / count
    spread = correlated(transformed((a**2).sum(axis=1)), mb) - (sa**2).sum(axis=1) / count
    least = REGULARISING_SPREAD * count * float((b**2).sum(axis=1).mean()) + 1e-12
    slope = np.linalg.solve(auto_covariance + least[:, None, None] * np.eye(3), cross_covariance.transpose(0, 2, 1))
    spread = spread + REGULARISING_SPREAD * count * float((a**2).sum(axis=1).mean()) + 1e-12
    return np.clip(np.einsum("nij,nji->n", cross_covariance, slope) / spread, 0.0, 1.0), count


@dataclass(frozen=True)
class MeanRates:
    """Means of the gyroscope's readings. angle (N, 3) rad: their integral from the first stamp to each."""

    imu: ImuData
    angle: np.ndarray

    @classmethod
    def of(cls, imu: ImuData) -> MeanRates:
        """Integrates the readings of `imu` by the trapezoidal rule."""
        return cls(imu, once_integrated(imu.gyro, np.diff(imu.seconds)))

    def over(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Mean rates (n, 3) rad/s over intervals from start to end (n,), in s on the IMU's clock."""
        t = self.imu.seconds
        return (interpolated(t, self.angle, end) - interpolated(t, self.angle, start)) / (end - start)[:, None]

    def slope(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Derivatives (n, 3) rad/s^2 of the mean rates by a common shift of start and end."""
        t, gyro = self.imu.seconds, self.imu.gyro
        return (interpolated(t, gyro, end) - interpolated(t, gyro, start)) / (end - start)[:, None]
