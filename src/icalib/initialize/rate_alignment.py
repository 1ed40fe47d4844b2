"""Time offset, rotation and gyroscope bias between a sensor and the IMU, from angular rates alone.

The time offset comes from correlation or regression, the rotation from Kabsch's method, both refined together.

Refuses recordings in which a clock was set forward by seconds. Such a jump looks like a gap, but the time offset
differs before and after it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry.small import MEDIAN_NORM
from icalib.initialize.rate_correlation import (
    RATE_MEAN_S,
    ChainedRates,
    SensorRates,
    best_offsets,
    interpolated,
    likely_offsets,
    moving_means,
)
from icalib.initialize.rate_regression import MeanRates, no_match_error, rate_difference_noise
from icalib.motion.imu_data import ImuData, other_axes

MAX_UNEXPLAINED_RATE = 0.35  # unexplained share of the angular rate above which the motions differ
MIN_TURN_RATIO = 0.3  # rate over its RMS, below which a vehicle that drives straight most of the time does not turn
LONG_RATE_MEAN_S = 0.5  # s: duration of the means that are compared if those over RATE_MEAN_S do not match
OFFSET_AGREEMENT_S = 0.01  # s: time offsets that differ by less agree
MAX_UNEXPLAINED_RATIO_OF_OTHER = 0.5  # unexplained rate at another offset over that at the present one, to replace it
MIN_COMMON_RATE_SHARE = 0.3  # projection over norm of the sensor's rate: below, a ratio of rates says nothing
STILL_RATE_RAD_S = 0.03  # rad/s: slower rotation is not distinguished from rest
MAX_NOISE_RATIO_AT_REST = 1.5  # RMS of the rate over the gyroscope's noise, below which means are compared instead
MIN_SECOND_AXIS_RATIO = 0.05  # spread of rates along the second axis over that along the first
MAX_ALIGNMENT_ITERATIONS = 12  # of Gauss-Newton and Kabsch in turns, at most
DEG_PER_RAD = 180.0 / np.pi  # ratio of rates in deg/s to rates in rad/s


class OneAxisError(EstimationError):
    """A sensor turned about one axis only, so its rotation about this axis is unobservable."""


@dataclass(frozen=True)
class RateAlignment:
    """offset: t_imu - t_sensor [s], both since their clocks' first stamps; rotation: R_imu_sensor (3, 3); gyro_bias
    (3,) rad/s."""

    offset: float
    rotation: np.ndarray
    gyro_bias: np.ndarray
    given: bool = False  # whether offset and rotation are those of the rig file


def align_rates(imu: ImuData, name: str, rates: SensorRates, given_offset: float | None) -> RateAlignment:
    """Estimates the alignment of the sensor `name`; with `given_offset` [s], at this offset. Raises EstimationError if
    the rates do not match at any offset, or units are wrong."""
    _check_motion(imu, name, rates)
    keep = given_offset is not None
    if rates.offsets == () and not keep:
        raise no_match_error(imu, name, rates)
    best, *others = likely_offsets(imu, name, rates) if given_offset is None else [given_offset]
    offsets = [best, *(x for x in others if covered(imu, rates, x).any())]
    # In a short recording angular speeds may match better at a wrong offset, but directions do not.
    (alike, alignment), averaged = _first_match(imu, [_align_near(imu, name, rates, x, keep) for x in offsets])
    refuse_clock_jumps(
        imu, name, alike, alignment.offset, lambda part, offset: _unexplained_at(imu, part, alignment, offset)
    )
    _check_offset(imu, name, unexplained_share(imu, alike, alignment, averaged), keep)
    _check_scale(imu, name, rates, alignment, averaged)
    return alignment


def _first_match(
    imu: ImuData, candidates: Sequence[tuple[SensorRates, RateAlignment]]
) -> tuple[tuple[SensorRates, RateAlignment], float]:
    """The first of the `candidates` whose unexplained rate is small enough, or the best one if it is clearly better.
    Also returns the duration [s] of the means that were compared.

    If none matches over RATE_MEAN_S, means over LONG_RATE_MEAN_S are compared: noise shrinks at least with the root of
    the duration, a different motion does not. If none matches then, returns the first.
    """
    unexplained = [unexplained_share(imu, *candidate) for candidate in candidates]
    alike = [k for k, share in enumerate(unexplained) if share <= MAX_UNEXPLAINED_RATE]
    if alike:
        best = int(np.argmin(unexplained))
        is_clear = unexplained[best] < MAX_UNEXPLAINED_RATIO_OF_OTHER * unexplained[alike[0]]
        return candidates[best if is_clear else alike[0]], RATE_MEAN_S
    for candidate in candidates:
        share = min(MAX_UNEXPLAINED_RATE, np.sqrt(RATE_MEAN_S / LONG_RATE_MEAN_S) * unexplained_share(imu, *candidate))
        if unexplained_share(imu, *candidate, LONG_RATE_MEAN_S) <= share:
            return candidate, LONG_RATE_MEAN_S
    return candidates[0], RATE_MEAN_S


def _align_near(
    imu: ImuData, name: str, rates: SensorRates, offset: float, keep_offset: bool
) -> tuple[SensorRates, RateAlignment]:
    """The alignment near one offset, and the rates. If their norms differ from the gyroscope's by a quarter or more, as
    by a wrong focal length, the rates are scaled."""
    if not covered(imu, rates, offset).any():
        raise no_overlap(imu, name)
    pair = _side_by_side(imu, rates, offset)
    _check_degrees(imu, name, *pair)
    rough = _alignment_at_offset(offset, *pair)
    scale = _rate_ratio(rough, *pair)
    alike = rates if 0.8 < scale < 1.25 else replace(rates, rate=scale * rates.rate)
    return alike, _refine(imu, alike, rough, keep_offset)


def rough_alignments(
    imu: ImuData, name: str, rates: SensorRates, offsets: Sequence[float] | None, guess: float
) -> list[RateAlignment]:
    """Alignments to search from, whether or not rates match: at the `offsets` [s]. None: at the best matches and at
    `guess`."""
    _check_motion(imu, name, rates)
    if offsets is None:
        offsets = [*best_offsets(imu, rates), guess]
    offsets = [x for x in dict.fromkeys(offsets) if covered(imu, rates, x).any()]
    return [_alignment_at_offset(x, *_side_by_side(imu, rates, x)) for x in offsets]


def covered(imu: ImuData, rates: SensorRates, offset: float) -> np.ndarray:
    """(n,) bool: intervals of the rates that lie within the IMU's recording and in none of its gaps."""
    return imu.covers(rates.start + offset, rates.end + offset)


def _check_offset(imu: ImuData, name: str, unexplained: float, given: bool) -> None:
    """Raises EstimationError if too much of the rate is unexplained. given: whether the rig file gives the offset."""
    if unexplained > MAX_UNEXPLAINED_RATE:
        where = "with the time_offset in the rig file" if given else "at any time offset"
        advice = (
            "correct it, or remove it so that it is estimated"
            if given
            else "check that both come from the same recording and overlap in time"
        )
        raise EstimationError(
            f"the motion of {name} does not match that of {imu.name} {where} ({unexplained:.0%} of the angular rate is "
            f"unexplained); {advice}."
        )


def unexplained_share(
    imu: ImuData, rates: SensorRates, alignment: RateAlignment, averaged: float = RATE_MEAN_S
) -> float:
    """Median difference between the rates of IMU and sensor, over the median rate, of means over `averaged` s. Means of
    a slow rotation are left out, because they show noise: a vehicle drives straight most of the time. The known noise
    of the sensor's rates is subtracted."""
    gyro, sensor = _side_by_side(imu, rates, alignment.offset, averaged)
    gyro, sensor = gyro - alignment.gyro_bias, sensor @ alignment.rotation.T
    size = np.linalg.norm(gyro, axis=1)
    turning = size >= MIN_TURN_RATIO * np.sqrt((size**2).mean())
    unexplained = float(np.median(np.linalg.norm(gyro - sensor, axis=1)[turning]))
    unexplained = np.sqrt(max(unexplained**2 - (MEDIAN_NORM * rate_difference_noise(imu, rates, averaged)) ** 2, 0.0))
    return float(unexplained / np.median(size[turning]))


def _unexplained_at(imu: ImuData, rates: SensorRates, alignment: RateAlignment, offset: float) -> float:
    """The unexplained share of `rates` at another offset; infinite if the IMU was not running."""
    shifted = replace(alignment, offset=offset)
    return unexplained_share(imu, rates, shifted) if covered(imu, rates, offset).any() else np.inf


def _side_by_side(
    imu: ImuData, rates: SensorRates, offset: float, averaged: float = RATE_MEAN_S
) -> tuple[np.ndarray, np.ndarray]:
    """Rates of gyroscope and sensor (n, 3) rad/s over the same intervals, each in its own axes, as means over about
    `averaged` s. A single rate is mostly noise if the target is far or the motion slow."""
    inside = covered(imu, rates, offset)
    start, end = rates.start[inside], rates.end[inside]
    gyro = _interval_rates(imu, rates).over(start + offset, end + offset)
    # Intervals may overlap: `count` of them cover `averaged` seconds.
    step = float(np.median(np.diff(start))) if len(start) > 1 else averaged
    count = min(max(1, 1 + round((averaged - float(np.median(end - start))) / step)), len(start))
    return moving_means(gyro, count), moving_means(rates.rate[inside], count)


def contradicting_offset(imu: ImuData, name: str, rates: SensorRates, expected: float) -> float | None:
    """The offset [s] at which the rates match, if it is clearly better than `expected`; else None."""
    try:
        alignment = align_rates(imu, name, rates, None)
    except EstimationError:
        return None  # the motion does not show it
    if abs(alignment.offset - expected) < OFFSET_AGREEMENT_S:
        return None
    if not covered(imu, rates, expected).any():
        return alignment.offset
    at_expected = _alignment_at_offset(expected, *_side_by_side(imu, rates, expected))
    return alignment.offset if better_alignment(imu, rates, at_expected, alignment) is alignment else None


def rms_rates(imu: ImuData, rates: SensorRates) -> tuple[float, float]:
    """How fast IMU and sensor turn [rad/s]: RMS of the IMU's rate about its median, and median of the sensor's rate. If
    the IMU's rate is hardly more than its noise, means over RATE_MEAN_S are used."""
    dt = float(np.median(np.diff(imu.seconds)))
    rate = imu.gyro - np.median(imu.gyro, axis=0)
    noise = np.sqrt(3.0 * np.median(imu.variance[:, 0]) / dt)
    if np.sqrt((rate**2).sum(axis=1).mean()) < MAX_NOISE_RATIO_AT_REST * noise:
        rate = moving_means(rate, min(max(1, round(RATE_MEAN_S / dt)), len(rate)))
    return float(np.sqrt((rate**2).sum(axis=1).mean())), float(np.sqrt(np.median((rates.rate**2).sum(axis=1))))


def is_still(imu_rate: float, sensor_rate: float) -> bool:
    """Whether neither sensor turned significantly. imu_rate, sensor_rate: results of `rms_rates`."""
    return imu_rate < STILL_RATE_RAD_S and sensor_rate < 3.0 * STILL_RATE_RAD_S


def _check_motion(imu: ImuData, name: str, rates: SensorRates) -> None:
    """Raises EstimationError if neither sensor turned significantly."""
    imu_rate, sensor_rate = rms_rates(imu, rates)
    if is_still(imu_rate, sensor_rate):
        raise EstimationError(
            f"the recording is motionless ({imu.name} turns at {imu_rate:.4f} rad/s RMS, {name} at "
            f"{sensor_rate:.4f}); record again while turning the rig about all axes in front of the target."
        )


def kabsch(w_imu: np.ndarray, w_cam: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R (3, 3) and bias (3,) with w_imu = R w_cam + bias (n, 3), by weighted least squares: means are removed, and R
    follows from the SVD of the covariance (Kabsch 1976)."""
    total = weight.sum()
    mi, mc = weight @ w_imu / total, weight @ w_cam / total
    U, _, Vt = np.linalg.svd(((w_imu - mi) * weight[:, None]).T @ (w_cam - mc))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ D @ Vt
    return R, mi - R @ mc


def _alignment_at_offset(offset: float, gyro: np.ndarray, sensor: np.ndarray) -> RateAlignment:
    """Rotation and bias at this offset from rates side by side. Means over several images suppress poses that flip to
    their mirrored solution and back."""
    return RateAlignment(offset, *kabsch(gyro, sensor, np.ones(len(gyro))))


def _interval_rates(imu: ImuData, rates: SensorRates) -> MeanRates | ChainedRates:
    """The gyroscope's rates over intervals as long as those of `rates`."""
    return ChainedRates.of(imu) if rates.are_slow else MeanRates.of(imu)


def _refine(imu: ImuData, rates: SensorRates, rough: RateAlignment, keep_offset: bool) -> RateAlignment:
    """Alternates Gauss-Newton on the offset with Kabsch on rotation and bias, without outliers. keep_offset: estimates
    rotation and bias only."""
    measured = _interval_rates(imu, rates)
    offset, R, bias, residual = rough.offset, rough.rotation, rough.gyro_bias, np.zeros_like(rates.rate)
    for _ in range(MAX_ALIGNMENT_ITERATIONS):
        start, end = rates.start + offset, rates.end + offset
        inside = covered(imu, rates, offset).astype(float)
        mean, slope = measured.over(start, end), measured.slope(start, end)
        weight = inside
        for _ in range(3):
            residual = mean - rates.rate @ R.T - bias
            size = np.linalg.norm(residual, axis=1)
            weight = inside * (size < 5.0 * np.median(size[inside > 0.0]) + 1e-9)
            R, bias = kabsch(mean, rates.rate, weight)
        if keep_offset:
            break
        step = -float((weight @ (slope * residual)).sum() / (weight @ slope**2).sum())
        offset += float(np.clip(step, -0.02, 0.02))
        if abs(step) < 1e-6:
            break
    return RateAlignment(offset, R, bias)


def turns_about_two_axes(imu: ImuData, rates: SensorRates, alignment: RateAlignment) -> bool:
    """Whether sensor and IMU both turned about more than one axis. Both are checked, as a camera far from the target
    measures rotations that are noise. If not, the rotation about this axis is unobservable."""
    middle = (0.5 * (rates.start + rates.end) + alignment.offset)[covered(imu, rates, alignment.offset)]
    gyro = interpolated(imu.seconds, imu.gyro, middle)
    return all(_second_axis(w) >= MIN_SECOND_AXIS_RATIO for w in (rates.rate, gyro))


def _second_axis(rate: np.ndarray) -> float:
    """Spread of rates (n, 3) along their second principal axis over that along the first."""
    spread, _ = _spread_axes(rate)
    return float(spread[1] / spread[0])


def only_axis(rate: np.ndarray, least: float) -> np.ndarray | None:
    """Unit vector (3,) of the single axis of rates or rotation vectors (n, 3); None if the spread along the second
    principal axis is at least `least` times that along the first. About a single axis the rotation is unobservable."""
    spread, axes = _spread_axes(rate)
    return axes[0] if spread[1] < least * spread[0] else None


def _spread_axes(rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Singular values of rates (n, 3) about their mean, and principal axes (3, 3) as rows, the widest first."""
    _, spread, axes = np.linalg.svd(rate - rate.mean(axis=0), full_matrices=False)
    return spread, axes


def main_axis(rate: np.ndarray) -> np.ndarray:
    """Unit vector (3,) of the first principal axis of rates (n, 3)."""
    return _spread_axes(rate)[1][0]


def check_two_axes(imu: ImuData, rates: SensorRates, alignment: RateAlignment, name: str, on_wheels: bool) -> None:
    """Raises OneAxisError if the sensor turned about one axis only. on_wheels: whether it is on a vehicle, which turns
    about other axes on slopes only."""
    if not turns_about_two_axes(imu, rates, alignment):
        axes = other_axes(imu.name, main_axis(imu.gyro))
        motion = "drive over ramps" if on_wheels else f"turn the rig about {axes} as well"
        raise OneAxisError(
            f"{name} turned about one axis only, so its rotation about that axis is unobservable; {motion}, or "
            "give `rotation` in the rig file."
        )


def better_at_offset(
    imu: ImuData, name: str, rates: SensorRates, alignment: RateAlignment, offset: float
) -> RateAlignment:
    """The `alignment`, or the one at a guessed `offset` [s] if rates match clearly better there. Rates about one axis
    also match a rotation that is reversed."""
    if not covered(imu, rates, offset).any():
        return alignment
    return better_alignment(imu, rates, alignment, alignment_as_stated(imu, name, rates, offset, alignment.rotation))


def better_alignment(
    imu: ImuData, rates: SensorRates, alignment: RateAlignment, alternative: RateAlignment
) -> RateAlignment:
    """`alignment`, or `alternative` if its unexplained rate is clearly smaller."""
    return (
        alternative
        if unexplained_share(imu, rates, alternative)
        < MAX_UNEXPLAINED_RATIO_OF_OTHER * unexplained_share(imu, rates, alignment)
        else alignment
    )


def alignment_as_stated(
    imu: ImuData, name: str, rates: SensorRates, offset: float, rotation: np.ndarray
) -> RateAlignment:
    """An alignment with the given offset [s] and rotation R_imu_sensor; only the gyroscope's bias is estimated. Raises
    EstimationError if the recordings do not overlap."""
    inside = covered(imu, rates, offset)
    if not inside.any():
        raise no_overlap(imu, name)
    if rates.are_slow:
        gyro = _interval_rates(imu, rates).over(rates.start[inside] + offset, rates.end[inside] + offset)
    else:
        gyro = interpolated(imu.seconds, imu.gyro, (0.5 * (rates.start + rates.end) + offset)[inside])
    return RateAlignment(offset, rotation, np.median(gyro - rates.rate[inside] @ rotation.T, axis=0), given=True)


def rates_contradict(imu: ImuData, rates: SensorRates, alignment: RateAlignment) -> bool:
    """Whether the sensors turned, but not as the `alignment` predicts."""
    (_, compared), averaged = _first_match(imu, [(rates, alignment)])
    return (
        not is_still(*rms_rates(imu, rates))
        and unexplained_share(imu, rates, compared, averaged) > MAX_UNEXPLAINED_RATE
    )


def no_overlap(imu: ImuData, name: str) -> EstimationError:
    """The error of recordings that do not overlap in time."""
    return EstimationError(
        f"no data of {name} fall within the recording of {imu.name}. Check that both come from the same "
        "recording, and that a time_offset in the rig file is in seconds, or remove it so that it is "
        "estimated."
    )


def _check_degrees(imu: ImuData, name: str, gyro: np.ndarray, sensor: np.ndarray) -> None:
    """Raises EstimationError if the gyroscope is in deg/s, by the norms of the rates (n, 3). It comes before the checks
    of the motion, which such rates would fail."""
    size = [np.linalg.norm(w - np.median(w, axis=0), axis=1) for w in (gyro, sensor)]
    ratio = float(np.median(size[0]) / max(np.median(size[1]), 1e-9))
    if 0.8 < ratio / DEG_PER_RAD < 1.25:
        raise EstimationError(
            f"{imu.name} turns {ratio:.3g} times as fast as {name}, so its angular rate is in deg/s; set "
            f"gyro_unit: deg/s of {imu.name} in the rig file."
        )


def _check_scale(imu: ImuData, name: str, rates: SensorRates, alignment: RateAlignment, averaged: float) -> None:
    """Raises EstimationError if the norms of the rates differ by more than a quarter."""
    ratio = _rate_ratio(alignment, *_side_by_side(imu, rates, alignment.offset, averaged))
    if not 0.8 < ratio < 1.25:
        raise EstimationError(
            f"{imu.name} turns {ratio:.3g} times as fast as {name}; check its units, or give the intrinsics in "
            "the rig file if the target is small in the images."
        )


def _rate_ratio(alignment: RateAlignment, gyro: np.ndarray, camera: np.ndarray) -> float:
    """Rate of the gyroscope over that of the sensor, both (n, 3) about their medians, which hold the bias. The sensor's
    rate is projected on the gyroscope's, so that its noise averages out, in the faster half of the means in which the
    vehicle turns, see `_unexplained`. 1 if the rates do not correlate."""
    gyro, camera = gyro - np.median(gyro, axis=0), (camera - np.median(camera, axis=0)) @ alignment.rotation.T
    size = np.linalg.norm(gyro, axis=1)
    fast = size >= max(np.median(size), MIN_TURN_RATIO * np.sqrt((size**2).mean()))
    along = np.median(np.einsum("na,na->n", gyro, camera)[fast] / size[fast])
    alike = along > MIN_COMMON_RATE_SHARE * np.median(np.linalg.norm(camera[fast], axis=1))
    return float(np.median(size[fast]) / along) if alike else 1.0


MIN_CLOCK_JUMP_S = 0.5  # s: shorter gaps are bridged by interpolation
MIN_RATES_BESIDE_JUMP = 10  # rates on a side of the gap: with fewer the unexplained share is mostly noise
MAX_MATCHING_UNEXPLAINED = 0.35  # largest unexplained share of the angular rate at which both sensors turn alike
MIN_DIFFERENT_UNEXPLAINED = 0.7  # smallest unexplained share at which they do not
UnexplainedShare = Callable[[SensorRates, float], float]


@dataclass(frozen=True)
class _ClockJump:
    """A gap that may be a jump of the clock of the sensor `whose`. size: length of the gap [s]; growth: change of the
    time offset [s].

    before: time of the jump [s, clock of the rates] if the present offset holds after it; after: the same if the
    present offset holds before it.
    """

    whose: str
    size: float
    before: float
    after: float
    growth: float


def refuse_clock_jumps(
    imu: ImuData, name: str, rates: SensorRates, offset: float, unexplained: UnexplainedShare
) -> None:
    """Raises EstimationError if a gap is a jump of a clock. On one side of such a gap both sensors turn alike at the
    `offset` [s], on the other side only at an offset that differs by the length of the gap.

    unexplained(rates, offset): share of the angular rate that the IMU does not explain, from 0 to 1.
    """
    for jump in _possible_jumps(imu, name, rates, offset):
        for side, shift in ((rates.start < jump.before, -jump.growth), (rates.start >= jump.after, jump.growth)):
            one_side, other_side = _selected(rates, side), _selected(rates, ~side)
            if (
                min(len(one_side.start), len(other_side.start)) < MIN_RATES_BESIDE_JUMP
                or unexplained(one_side, offset) < MIN_DIFFERENT_UNEXPLAINED
            ):
                continue
            if (
                unexplained(one_side, offset + shift) < MAX_MATCHING_UNEXPLAINED
                and unexplained(other_side, offset) < MAX_MATCHING_UNEXPLAINED
            ):
                at = (jump.before if shift == -jump.growth else jump.after) - rates.start[0]
                raise EstimationError(
                    f"the clock of {jump.whose} was set forward by {jump.size:.3g} s about {at:.3g} s after "
                    f"{name} began, so the time offset differs before and after; use one side with --from and "
                    "--to."
                )


def _possible_jumps(imu: ImuData, name: str, rates: SensorRates, offset: float) -> list[_ClockJump]:
    """Gaps of the IMU's readings and of the rates that are longer than MIN_CLOCK_JUMP_S. offset [s]: time of the IMU
    minus time of the rates."""
    step = float(np.median(np.diff(imu.seconds)))
    # A jump of the IMU's clock adds to the time offset, one of the other clock reduces it.
    jumps = [_ClockJump(imu.name, b - a - step, b - offset, a - offset, b - a - step) for a, b in imu.gaps]
    size = rates.start[1:] - np.maximum.accumulate(rates.end)[:-1] - float(np.median(np.diff(rates.start)))
    for k in np.flatnonzero(size > MIN_CLOCK_JUMP_S):
        begin = float(rates.start[k + 1])
        jumps.append(_ClockJump(name, float(size[k]), begin, begin, -float(size[k])))
    return [x for x in jumps if x.size > MIN_CLOCK_JUMP_S]


def _selected(rates: SensorRates, kept: np.ndarray) -> SensorRates:
    """The rates where `kept` (n,) is true."""
    return replace(rates, start=rates.start[kept], end=rates.end[kept], rate=rates.rate[kept])
