"""Time offsets from angular rates: correlation of their size, then rotation angles between instants."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.motion.imu_data import SAME_INSTANT_S, ImuData, clear_of

# Time offsets between a sensor and the IMU, by cross-correlation of the norms of their angular rates.
#
# The lag between two signals: masked, normalised cross-correlation over all shifts, by FFT (Padfield, IEEE Trans.
# Image Processing, 2012).

CORRELATION_GRID_HZ = 100.0  # of the grid: offsets are found to 5 ms
MAX_RATE_STEP_S = 0.25  # s: longest step between neighbours that gives an angular rate, unless the stream is slower
MAX_USUAL_STEPS = 1.5  # median steps: longest step of a slower stream
MAX_SLOW_STEP_S = 2.0  # s: longest step of any stream
MIN_RATE_OVERLAP_S = 4.0  # s: a shorter overlap correlates by chance
MIN_RATE_CORRELATION = 0.7  # of angular speeds that match
MAX_OFFSET_PEAKS = 5  # peaks of the correlation that are tried
MIN_PEAK_DISTANCE_S = 0.25  # s between two such peaks
RATE_MEAN_S = 0.25  # s: duration of the means that are compared
MAX_ANGLE_MISFIT = 0.5  # RMS difference over the spread of rotation angles in long intervals


@dataclass(frozen=True)
class SensorRates:
    """Mean angular rates of a sensor between neighbouring images, scans or poses: start, end (n,) s on its clock; rate
    (n, 3) rad/s in its axes.

    least_correlation: smallest correlation with the IMU's rates that counts as a match; longest_step_s: between
    neighbours; noise: standard deviation [rad/s] about each axis, 0 if unknown; offsets [s]: candidates by regression,
    best first, None if there was no regression.
    """

    start: np.ndarray
    end: np.ndarray
    rate: np.ndarray
    least_correlation: float = MIN_RATE_CORRELATION
    longest_step_s: float = MAX_RATE_STEP_S
    noise: float = 0.0
    offsets: tuple[float, ...] | None = None

    @property
    def are_slow(self) -> bool:
        """Whether intervals are so long that the rate changes much within them."""
        return self.longest_step_s > MAX_RATE_STEP_S


def max_rate_step(name: str, seconds: np.ndarray, noun: str, slowest_s: float = MAX_SLOW_STEP_S) -> float:
    """The longest step [s] between neighbours of increasing instants (n,) s that gives an angular rate; a longer step
    is a gap. noun: plural, for the sensor's measurements. Raises EstimationError if the median step exceeds
    `slowest_s`."""
    usual = float(np.median(np.diff(seconds)))
    if usual > slowest_s:
        raise EstimationError(
            f"{name}: the rate of {1.0 / usual:.2g} {noun} per second is too low to follow its motion, at "
            f"least {1.0 / slowest_s:g} are needed; record at a higher rate."
        )
    return min(max(MAX_RATE_STEP_S, MAX_USUAL_STEPS * usual), slowest_s)


def likely_offsets(imu: ImuData, name: str, rates: SensorRates) -> list[float]:
    """Candidate time offsets [s], the best first: peaks of the correlation of angular speed. Rates and their moving
    means are both tried, as fast motion shows in the former and slow motion in the latter. Candidates by regression are
    preferred if there are some. Raises EstimationError if no offset matches."""
    if rates.are_slow:
        return _offsets_of_slow_rates(imu, name, rates)
    if rates.offsets:
        return list(rates.offsets)
    peaks = max(_correlation_peaks(imu, rates), key=lambda p: _correlation_or_least(p[0]))
    if not peaks[0].correlation > rates.least_correlation:
        raise EstimationError(
            f"the motion of {name} does not match that of {imu.name} at any time offset "
            f"({correlation_in_words(peaks[0].largest)}); check that both are of one recording and overlap in time."
        )
    return [p.samples / CORRELATION_GRID_HZ for p in peaks if p.correlation > rates.least_correlation]


def _offsets_of_slow_rates(imu: ImuData, name: str, rates: SensorRates) -> list[float]:
    """As `likely_offsets`, for long intervals: by rotation angles. Raises EstimationError if no offset matches."""
    candidates = offsets_by_angle(imu, rates.start, rates.end, rates.rate)
    alike = [offset for offset, misfit in candidates if misfit < MAX_ANGLE_MISFIT]
    if not alike:
        in_radians = replace(imu, gyro=np.deg2rad(imu.gyro))
        if any(
            misfit < MAX_ANGLE_MISFIT for _, misfit in offsets_by_angle(in_radians, rates.start, rates.end, rates.rate)
        ):
            raise EstimationError(
                f"the angular rate of {imu.name} matches {name} if it is in deg/s; set gyro_unit: deg/s of "
                f"{imu.name} in the rig file."
            )
        misfit = (
            f"at best {candidates[0][1]:.0%} of the rotation is unexplained"
            if candidates
            else "they do not overlap in time"
        )
        raise EstimationError(
            f"the rotation of {name}, {MAX_USUAL_STEPS / rates.longest_step_s:.2g} poses per second, does not "
            f"match that of {imu.name} at any time offset ({misfit}). Check that both come from the same "
            "recording and overlap in time, or record at a higher rate."
        )
    return alike


def correlation_in_words(largest: float) -> str:
    """The largest correlation over all shifts, as a clause."""
    if not np.isfinite(largest):
        return f"they never overlap for {MIN_RATE_OVERLAP_S:g} s without a gap"
    return f"best correlation {max(largest, 0.0):.2f}"


def best_offsets(imu: ImuData, rates: SensorRates) -> list[float]:
    """The best offset [s] for rates and for their moving means, however poor the match."""
    if rates.offsets:
        return list(rates.offsets)
    if rates.are_slow:
        return [offset for offset, _ in offsets_by_angle(imu, rates.start, rates.end, rates.rate)]
    return [p[0].samples / CORRELATION_GRID_HZ for p in _correlation_peaks(imu, rates) if np.isfinite(p[0].correlation)]


def _correlation_peaks(imu: ImuData, rates: SensorRates) -> list[list[CorrelationPeak]]:
    """Peaks of the correlation of the rates, and of their moving means over RATE_MEAN_S."""
    return [_peaks_of_means(imu, rates, count) for count in (1, round(RATE_MEAN_S * CORRELATION_GRID_HZ))]


def _peaks_of_means(imu: ImuData, rates: SensorRates, count: int) -> list[CorrelationPeak]:
    """Peaks of the correlation with gyroscope rates, both averaged over `count` grid points. The gyroscope's median,
    which holds its bias and any steady rotation, is subtracted if that correlates better."""
    covered = ~np.isin(imu.seconds, [start for start, _ in imu.gaps])
    middle = 0.5 * (rates.start + rates.end)
    near = np.diff(middle, append=middle[-1]) < rates.longest_step_s
    sensor_speed = _rate_size_on_grid(middle, rates.rate, near, count)
    gyro_speeds = (
        _rate_size_on_grid(imu.seconds, imu.gyro - about, covered, count)
        for about in (0.0, np.median(imu.gyro, axis=0))
    )
    least, apart = MIN_RATE_OVERLAP_S * CORRELATION_GRID_HZ, round(MIN_PEAK_DISTANCE_S * CORRELATION_GRID_HZ)
    return max(
        (best_shifts(a, sensor_speed, least, MAX_OFFSET_PEAKS, apart) for a in gyro_speeds),
        key=lambda p: _correlation_or_least(p[0]),
    )


def _rate_size_on_grid(
    t: np.ndarray, rate: np.ndarray, covered: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Norms of rates (n, 3) on a regular grid from 0 to t[-1], after means over `count` grid points. Also returns a
    mask of the means whose points are all covered."""
    grid = np.arange(int(t[-1] * CORRELATION_GRID_HZ) + 1) / CORRELATION_GRID_HZ
    count = min(count, len(grid))
    on_grid = np.interp(grid, t, covered.astype(float)) > 0.99
    fine = interpolated(t, rate, grid)
    return np.linalg.norm(moving_means(fine, count), axis=1), moving_means(np.tile(on_grid[:, None], 3), count)[
        :, 0
    ] > 0.99


def _correlation_or_least(shift: CorrelationPeak) -> float:
    """The correlation of a peak, -1 if there is none."""
    return shift.correlation if np.isfinite(shift.correlation) else -1.0


def moving_means(values: np.ndarray, count: int) -> np.ndarray:
    """(n - count + 1, 3) means over `count` neighbours of values (n, 3)."""
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(values, axis=0)])
    return (total[count:] - total[:-count]) / count


def interpolated(t: np.ndarray, values: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """(n, 3) values at `seconds` (n,), by linear interpolation of values (N, 3) at `t` (N,) s."""
    return np.stack([np.interp(seconds, t, values[:, k]) for k in range(3)], axis=1)


F = TypeVar("F")
MAX_EQUAL_RATIO = 1.5  # misfits that differ by less are equal: a route that repeats itself fits at several offsets


def closest_of_equals(fits: Iterable[tuple[float, float, F]], same_clock: float, floor: float) -> F | None:
    """The best of `fits`, each a misfit, a time offset [s] and a result. Among misfits that are equal, or below
    `floor`, the offset closest to `same_clock` wins: that of stamps by one clock. None without fits."""
    ranked = sorted(fits, key=lambda fit: fit[0])
    equal = [fit for fit in ranked if fit[0] <= MAX_EQUAL_RATIO * max(floor, ranked[0][0])]
    return min(equal, key=lambda fit: abs(fit[1] - same_clock))[2] if equal else None


MaskedSignal = tuple[np.ndarray, np.ndarray]  # values, and bool: which of them are known


class CorrelationPeak(NamedTuple):
    """Signal b(t) is most like a(t + samples). correlation: Pearson's coefficient at this shift; largest: at
    any shift. score: Fisher's z (atanh of the correlation) times the root of the overlap in samples."""

    samples: int
    correlation: float
    largest: float
    score: float


def best_shift(a: MaskedSignal, b: MaskedSignal, least: float) -> CorrelationPeak:
    """The shift between the signals a (n,) and b (m,), sampled on one regular grid, at which they are most alike. Only
    samples where both masks are true count. At least `least` samples must overlap, or half of the known ones if these
    are fewer."""
    return best_shifts(a, b, least, 1, 0)[0]


def best_shifts(
    signal_a: MaskedSignal, signal_b: MaskedSignal, least: float, most: int, apart: int
) -> list[CorrelationPeak]:
    """At most `most` peaks, the best first, each more than `apart` samples from the better ones. See `best_shift`.
    Peaks are ranked by their score, so that a long overlap outweighs a short one."""
    (a, mask_a), (b, mask_b) = signal_a, signal_b
    n = len(a) + len(b) - 1
    size = 1 << (n - 1).bit_length()

    def correlate(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """sum_t x(t + lag) y(t) for lags from -(len(y) - 1) to len(x) - 1."""
        product = np.fft.irfft(np.fft.rfft(x, size) * np.conj(np.fft.rfft(y, size)), size)
        return np.concatenate([product[-(len(b) - 1) :], product[: len(a)]]) if len(b) > 1 else product[: len(a)]

    ma, mb = mask_a.astype(float), mask_b.astype(float)
    count = np.maximum(correlate(ma, mb), 1e-9)
    sa, sb = correlate(a * ma, mb), correlate(ma, b * mb)
    saa, sbb = correlate(a * a * ma, mb), correlate(ma, b * b * mb)
    covariance = correlate(a * ma, b * mb) - sa * sb / count
    variance = np.maximum(saa - sa**2 / count, 0.0) * np.maximum(sbb - sb**2 / count, 0.0)
    fewer = min(mask_a.sum(), mask_b.sum())
    enough = count > min(least, 0.5 * fewer)
    # The floor, a share of the whole variance, keeps a short overlap with little motion from winning.
    floor = 1e-3 * (a[mask_a].var() * b[mask_b].var()) * count**2
    r = np.where(enough, covariance / np.sqrt(variance + floor), 0.0)
    score = np.arctanh(np.clip(r, 0.0, 0.999999)) * np.sqrt(count)
    peaks = []
    for _ in range(most):
        k = int(np.argmax(score))
        peaks.append(CorrelationPeak(k - (len(b) - 1), float(r[k]), float(r.max()), float(score[k])))
        score[max(k - apart, 0) : k + apart + 1] = -np.inf
        if not np.isfinite(score).any():
            break
    return peaks


# Rotation by integrating the gyroscope, which interpolates between rotations that are known at some instants.
#
# Time offset of a slow stream: images or poses up to 2 s apart, between which the angular rate changes much.
#
# The mean rate of such an interval says little. The rotation angle over it is exact, though, and so is the angle that
# the gyroscope integrates to. Both angles are equal, whatever the extrinsics.

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
