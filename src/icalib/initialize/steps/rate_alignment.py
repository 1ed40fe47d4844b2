"""Time offset and rotation between a camera and the IMU, from angular rates alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.data.measurements import CornerStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.vectors import MEDIAN_NORM
from icalib.initialize.steps.clock_jumps import refuse_clock_jumps
from icalib.initialize.steps.gyro_rates import MeanRates
from icalib.initialize.steps.rate_correlation import (
    RATE_MEAN_S,
    SensorRates,
    best_offsets,
    interpolated,
    likely_offsets,
    max_rate_step,
    moving_means,
)
from icalib.initialize.steps.rate_regression import no_match_error, rate_difference_noise
from icalib.initialize.steps.target_poses import TargetPoses
from icalib.initialize.steps.turned_angles import ChainedRates
from icalib.motion.axes import other_axes
from icalib.motion.imu_data import ImuData

MIN_IMAGE_PAIRS = 20  # of neighbouring images
MAX_UNEXPLAINED_RATE = 0.35  # of the angular rate
LONG_RATE_MEAN_S = 0.5  # over which noisy rates are compared where over AVERAGED_S they are not alike
OFFSET_AGREEMENT_S = 0.01  # of the time offsets that two recordings show
MAX_UNEXPLAINED_RATIO_OF_OTHER = 0.5  # of what another offset leaves unexplained
MIN_COMMON_RATE_SHARE = 0.3  # share of the camera's rate that goes with the IMU's, below which their ratio says nothing
STILL_RATE_RAD_S = 0.03
MAX_NOISE_RATIO_AT_REST = 1.5  # times what noise makes of the rate
_SAME_RECORDING = "check that both come from the same recording, overlap in time, and are in rad/s"
MIN_SECOND_AXIS_RATIO = 0.05  # of the spread of rates about the first
MAX_ALIGNMENT_ITERATIONS = 12
DEG_PER_RAD = 180.0 / np.pi


class OneAxisError(EstimationError):
    """A camera turned about one axis only, and the turn about it is open."""


@dataclass(frozen=True)
class RateAlignment:
    """offset: t_imu - t_camera, both since their clock's first stamp [s]; R_imu_cam; gyro_bias (3,) rad/s."""

    offset: float
    rotation: np.ndarray
    gyro_bias: np.ndarray
    given: bool = False  # offset and rotation are the rig file's, and as good as these


def camera_rates(stream: CornerStream, poses: TargetPoses) -> SensorRates:
    """Angular rates from consecutive good poses. Raises EstimationError where there are hardly any."""
    t = stream.seconds
    index = np.flatnonzero(poses.ok)
    if len(index) < 2:
        raise EstimationError(
            f"{stream.name}: the pose of the target was found in only {len(index)} of {len(t)} images; check "
            "the target, the camera model and the intrinsics in the rig file."
        )
    a, b = index[:-1], index[1:]
    longest = max_rate_step(stream.name, t[index], "images of the target")
    near = t[b] - t[a] <= longest
    a, b = a[near], b[near]
    if len(a) < MIN_IMAGE_PAIRS:
        raise EstimationError(
            f"{stream.name}: only {len(a)} pairs of consecutive images, at most {longest:.3g} s apart, show "
            f"the target, and {MIN_IMAGE_PAIRS} are needed; record for at least ten seconds."
        )
    turn = so3.log_many(np.ascontiguousarray(poses.rotation[a].transpose(0, 2, 1) @ poses.rotation[b]))
    return SensorRates(t[a], t[b], turn / (t[b] - t[a])[:, None], longest_step_s=longest)


def align_rates(imu: ImuData, name: str, rates: SensorRates, given_offset: float | None) -> RateAlignment:
    """Offset, rotation and gyro bias. Raises EstimationError where the rates do not match at any shift."""
    _check_motion(imu, name, rates)
    keep = given_offset is not None
    if rates.offsets == () and not keep:
        raise no_match_error(imu, name, rates)
    best, *others = likely_offsets(imu, name, rates) if given_offset is None else [given_offset]
    offsets = [best, *(x for x in others if covered(imu, rates, x).any())]
    # In a short recording the sizes of the rates may be more alike elsewhere, but not their directions.
    (alike, found), averaged = _first_match(imu, [_align_near(imu, name, rates, x, keep) for x in offsets])
    refuse_clock_jumps(imu, name, alike, found.offset, lambda part, offset: _unexplained_at(imu, part, found, offset))
    _check_offset(imu, name, _unexplained(imu, alike, found, averaged), keep)
    _check_scale(imu, name, rates, found, averaged)
    return found


def _first_match(
    imu: ImuData, tried: Sequence[tuple[SensorRates, RateAlignment]]
) -> tuple[tuple[SensorRates, RateAlignment], float]:
    """The first at which the two turn alike, but a later one where they turn far more alike, and over how long; or if
    they do nowhere the very first. Over LONGER_S what is noise shrinks with the root of that at least, another motion
    does not."""
    left = [_unexplained(imu, *one) for one in tried]
    alike = [k for k, share in enumerate(left) if share <= MAX_UNEXPLAINED_RATE]
    if alike:
        best = int(np.argmin(left))
        return tried[best if left[best] < MAX_UNEXPLAINED_RATIO_OF_OTHER * left[alike[0]] else alike[0]], RATE_MEAN_S
    for one in tried:
        share = min(MAX_UNEXPLAINED_RATE, np.sqrt(RATE_MEAN_S / LONG_RATE_MEAN_S) * _unexplained(imu, *one))
        if _unexplained(imu, *one, LONG_RATE_MEAN_S) <= share:
            return one, LONG_RATE_MEAN_S
    return tried[0], RATE_MEAN_S


def _align_near(
    imu: ImuData, name: str, rates: SensorRates, offset: float, keep_offset: bool
) -> tuple[SensorRates, RateAlignment]:
    """From one offset: the rates, as large as the gyroscope's where a guessed lens makes them too large or too small,
    and how they go together."""
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
    """Where to search from, whether the rates match or not: at the `offsets`, or if there are none where the angular
    rates go together best, and at the `guess`."""
    _check_motion(imu, name, rates)
    if offsets is None:
        offsets = [*best_offsets(imu, rates), guess]
    offsets = [x for x in dict.fromkeys(offsets) if covered(imu, rates, x).any()]
    return [_alignment_at_offset(x, *_side_by_side(imu, rates, x)) for x in offsets]


def covered(imu: ImuData, rates: SensorRates, offset: float) -> np.ndarray:
    """(n,) bool: image intervals within the IMU's recording and none of its gaps."""
    return imu.covers(rates.start + offset, rates.end + offset)


def _check_offset(imu: ImuData, name: str, unexplained: float, given: bool) -> None:
    """An offset at which the two do not turn alike is wrong, or the recordings do not belong together."""
    if unexplained > MAX_UNEXPLAINED_RATE:
        where = "with the time_offset in the rig file" if given else "at any time offset"
        advice = "correct it, or remove it so that it is estimated" if given else _SAME_RECORDING
        raise EstimationError(
            f"the motion of {name} does not match that of {imu.name} {where} ({unexplained:.0%} of the angular rate is "
            f"unexplained); {advice}."
        )


def _unexplained(imu: ImuData, rates: SensorRates, found: RateAlignment, averaged: float = RATE_MEAN_S) -> float:
    """Share of the angular rate that the camera did not see, of means over `averaged` seconds, beyond the noise of the
    camera's rates, where it is known."""
    gyro, seen = _side_by_side(imu, rates, found.offset, averaged)
    gyro, seen = gyro - found.gyro_bias, seen @ found.rotation.T
    left = float(np.median(np.linalg.norm(gyro - seen, axis=1)))
    left = np.sqrt(max(left**2 - (MEDIAN_NORM * rate_difference_noise(imu, rates, averaged)) ** 2, 0.0))
    return float(left / np.median(np.linalg.norm(gyro, axis=1)))


def _unexplained_at(imu: ImuData, rates: SensorRates, found: RateAlignment, offset: float) -> float:
    """What is unexplained of some of the rates at another offset; infinite where the IMU was not running."""
    there = replace(found, offset=offset)
    return _unexplained(imu, rates, there) if covered(imu, rates, offset).any() else np.inf


def _side_by_side(
    imu: ImuData, rates: SensorRates, offset: float, averaged: float = RATE_MEAN_S
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) each, rad/s in own axes: what the gyroscope and the camera have, both as means over some images: a rate
    between neighbours has little but noise where the target is far or the motion slow."""
    inside = covered(imu, rates, offset)
    start, end = rates.start[inside], rates.end[inside]
    gyro = _interval_rates(imu, rates).over(start + offset, end + offset)
    # Windows may overlap: so many of them cover `averaged` seconds.
    step = float(np.median(np.diff(start))) if len(start) > 1 else averaged
    count = min(max(1, 1 + round((averaged - float(np.median(end - start))) / step)), len(start))
    return moving_means(gyro, count), moving_means(rates.rate[inside], count)


def contradicting_offset(imu: ImuData, name: str, rates: SensorRates, expected: float) -> float | None:
    """The offset at which the two turn alike, where it is clearly another than the `expected` one; else None."""
    try:
        own = align_rates(imu, name, rates, None)
    except EstimationError:
        return None  # the motion does not show it
    if abs(own.offset - expected) < OFFSET_AGREEMENT_S:
        return None
    if not covered(imu, rates, expected).any():
        return own.offset
    there = _unexplained(imu, rates, _alignment_at_offset(expected, *_side_by_side(imu, rates, expected)))
    return own.offset if _unexplained(imu, rates, own) < MAX_UNEXPLAINED_RATIO_OF_OTHER * there else None


def rms_rates(imu: ImuData, rates: SensorRates) -> tuple[float, float]:
    """How the IMU turned and how the camera, rad/s: RMS about the median, of means over AVERAGED_S where it is no more
    than noise explains; and the median."""
    dt = float(np.median(np.diff(imu.seconds)))
    rate = imu.gyro - np.median(imu.gyro, axis=0)
    noise = np.sqrt(3.0 * np.median(imu.variance[:, 0]) / dt)
    if np.sqrt((rate**2).sum(axis=1).mean()) < MAX_NOISE_RATIO_AT_REST * noise:
        rate = moving_means(rate, min(max(1, round(RATE_MEAN_S / dt)), len(rate)))
    return float(np.sqrt((rate**2).sum(axis=1).mean())), float(np.sqrt(np.median((rates.rate**2).sum(axis=1))))


def is_still(turned: float, seen: float) -> bool:
    """Whether neither turned to speak of; see `turning`."""
    return turned < STILL_RATE_RAD_S and seen < 3.0 * STILL_RATE_RAD_S


def _check_motion(imu: ImuData, name: str, rates: SensorRates) -> None:
    turned, seen = rms_rates(imu, rates)
    if is_still(turned, seen):
        raise EstimationError(
            f"the recording is motionless ({imu.name} turns at {turned:.4f} rad/s RMS, {name} at {seen:.4f}); "
            "record again while turning the rig about all axes in front of the target."
        )


def kabsch(w_imu: np.ndarray, w_cam: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R and bias with w_imu = R w_cam + bias: means removed, then an SVD."""
    total = weight.sum()
    mi, mc = weight @ w_imu / total, weight @ w_cam / total
    U, _, Vt = np.linalg.svd(((w_imu - mi) * weight[:, None]).T @ (w_cam - mc))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ D @ Vt
    return R, mi - R @ mc


def _alignment_at_offset(offset: float, gyro: np.ndarray, seen: np.ndarray) -> RateAlignment:
    """At this offset, from means over some images: a pose that flips to its mirror image and back cancels in them."""
    return RateAlignment(offset, *kabsch(gyro, seen, np.ones(len(gyro))))


def _interval_rates(imu: ImuData, rates: SensorRates) -> MeanRates | ChainedRates:
    """What compares with rates over such intervals."""
    return ChainedRates.of(imu) if rates.are_slow else MeanRates.of(imu)


def _refine(imu: ImuData, rates: SensorRates, rough: RateAlignment, keep_offset: bool) -> RateAlignment:
    """Gauss-Newton on the offset, Kabsch on rotation and bias in turn; rates are means over each image interval."""
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


def turns_about_two_axes(imu: ImuData, rates: SensorRates, found: RateAlignment) -> bool:
    """Whether the camera turned about more than one axis, and the IMU with it: of a target far away a camera alone
    sees turns that are noise. Else its rotation about that axis stays open."""
    middle = (0.5 * (rates.start + rates.end) + found.offset)[covered(imu, rates, found.offset)]
    gyro = interpolated(imu.seconds, imu.gyro, middle)
    return all(_second_axis(w) >= MIN_SECOND_AXIS_RATIO for w in (rates.rate, gyro))


def _second_axis(rate: np.ndarray) -> float:
    """The spread of rates (n, 3) about their second axis over that about the first."""
    spread, _ = _spread_axes(rate)
    return float(spread[1] / spread[0])


def only_axis(rate: np.ndarray, least: float) -> np.ndarray | None:
    """(3,) the axis of rates (n, 3), or turns, where there is no other: of those about the second there are less than
    `least` of those about the first, and how much is turned about the axis itself they do not show."""
    spread, axes = _spread_axes(rate)
    return axes[0] if spread[1] < least * spread[0] else None


def _spread_axes(rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How rates (n, 3) spread about their axes (3, 3), by rows, the widest first."""
    _, spread, axes = np.linalg.svd(rate - rate.mean(axis=0), full_matrices=False)
    return spread, axes


def main_axis(rate: np.ndarray) -> np.ndarray:
    """(3,) the axis that rates (n, 3) spread about most."""
    return _spread_axes(rate)[1][0]


def check_two_axes(imu: ImuData, rates: SensorRates, found: RateAlignment, name: str, on_wheels: bool) -> None:
    """Raises OneAxisError where the camera turned about one axis only. on_wheels: a vehicle, which turns about others
    on slopes only."""
    if not turns_about_two_axes(imu, rates, found):
        axes = other_axes(imu.name, main_axis(imu.gyro))
        motion = "drive over ramps" if on_wheels else f"turn the rig about {axes} as well"
        raise OneAxisError(
            f"{name} turned about one axis only, so its rotation about that axis is unobservable; {motion}, or "
            "give `rotation` in the rig file."
        )


def better_at_offset(imu: ImuData, name: str, rates: SensorRates, found: RateAlignment, offset: float) -> RateAlignment:
    """`found`, or what a guess of the `offset` makes of it where the two turn alike there far better: rates about one
    axis fit the other way round, too."""
    if not covered(imu, rates, offset).any():
        return found
    return better_alignment(imu, rates, found, alignment_as_stated(imu, name, rates, offset, found.rotation))


def better_alignment(imu: ImuData, rates: SensorRates, found: RateAlignment, other: RateAlignment) -> RateAlignment:
    """`found`, or the other where the two turn far more alike there."""
    return (
        other
        if _unexplained(imu, rates, other) < MAX_UNEXPLAINED_RATIO_OF_OTHER * _unexplained(imu, rates, found)
        else found
    )


def alignment_as_stated(
    imu: ImuData, name: str, rates: SensorRates, offset: float, rotation: np.ndarray
) -> RateAlignment:
    """An alignment with this offset and rotation, whatever the motion: only the gyro bias is found. Raises
    EstimationError where clocks do not overlap."""
    inside = covered(imu, rates, offset)
    if not inside.any():
        raise no_overlap(imu, name)
    if rates.are_slow:
        gyro = _interval_rates(imu, rates).over(rates.start[inside] + offset, rates.end[inside] + offset)
    else:
        gyro = interpolated(imu.seconds, imu.gyro, (0.5 * (rates.start + rates.end) + offset)[inside])
    return RateAlignment(offset, rotation, np.median(gyro - rates.rate[inside] @ rotation.T, axis=0), given=True)


def rates_contradict(imu: ImuData, rates: SensorRates, given: RateAlignment) -> bool:
    """Whether the two turn, but not alike, even allowing for what a guess is off."""
    (_, found), averaged = _first_match(imu, [(rates, given)])
    return not is_still(*rms_rates(imu, rates)) and _unexplained(imu, rates, found, averaged) > MAX_UNEXPLAINED_RATE


def no_overlap(imu: ImuData, name: str) -> EstimationError:
    return EstimationError(
        f"no data of {name} fall within the recording of {imu.name}. Check that both come from the same "
        "recording, and that a time_offset in the rig file is in seconds, or remove it so that it is "
        "estimated."
    )


def _check_degrees(imu: ImuData, name: str, gyro: np.ndarray, seen: np.ndarray) -> None:
    """By size alone: readings in degrees match no camera's motion, and must not be blamed for that."""
    size = [np.linalg.norm(w - np.median(w, axis=0), axis=1) for w in (gyro, seen)]
    ratio = float(np.median(size[0]) / max(np.median(size[1]), 1e-9))
    if 0.8 < ratio / DEG_PER_RAD < 1.25:
        raise EstimationError(
            f"{imu.name} turns {ratio:.3g} times as fast as {name}, so its angular rate is in deg/s; set "
            f"gyro_unit: deg/s of {imu.name} in the rig file."
        )


def _check_scale(imu: ImuData, name: str, rates: SensorRates, found: RateAlignment, averaged: float) -> None:
    """The two must turn equally fast."""
    ratio = _rate_ratio(found, *_side_by_side(imu, rates, found.offset, averaged))
    if not 0.8 < ratio < 1.25:
        raise EstimationError(
            f"{imu.name} turns {ratio:.3g} times as fast as {name}; check its units, or give the intrinsics in "
            "the rig file if the target is small in the images."
        )


def _rate_ratio(found: RateAlignment, gyro: np.ndarray, camera: np.ndarray) -> float:
    """How much faster the gyroscope turns than the camera, side by side: both about their medians, as a bias has no
    say, and along the gyroscope's axis, where noise of the camera, which would make it seem slower, has none. Where
    it does not turn alike at all, none is faster."""
    gyro, camera = gyro - np.median(gyro, axis=0), (camera - np.median(camera, axis=0)) @ found.rotation.T
    size = np.linalg.norm(gyro, axis=1)
    fast = size > np.median(size)
    along = np.median(np.einsum("na,na->n", gyro, camera)[fast] / size[fast])
    alike = along > MIN_COMMON_RATE_SHARE * np.median(np.linalg.norm(camera[fast], axis=1))
    return float(np.median(size[fast]) / along) if alike else 1.0
