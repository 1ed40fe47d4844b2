"""Estimates the noise of an IMU from a recording at rest, and warns of wrong units, rounding and short recordings.

The overlapping Allan deviation of readings (IEEE Std 952, annex C).

Evenly sampled readings of an IMU, and the stretches of them at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from icalib.data.measurements import ImuStream
from icalib.data.messages import find_topic, listing
from icalib.data.recordings import Recording, open_recording
from icalib.data.stamps import ClockJumps, true_runs
from icalib.errors import EstimationError, RecordingError
from icalib.rig import AccelUnit, GyroUnit, ImuSensor, TwoSources
from icalib.sensors.imu.read import DEGREE, both, pair_of, read_imu
from icalib.sensors.imu.spec import DEFAULT_CLASS, class_noise

AXES = ("x", "y", "z")
_WALK_KNOWN = 1.0  # largest `AllanFit.lacking` without a warning
_WORSE = 1.5  # an axis with a density of more than this many mean densities gets a warning
_MISFIT = 0.15  # largest `AllanFit.misfit` without a warning
_NOISIEST_GYRO = 1e-3  # rad/s/sqrt(Hz): no gyroscope on sale is noisier; the figure of a quiet one in deg/s may be
_APART = 5.0  # ratio of gyroscope to accelerometer noise, each relative to its class: vibration would raise both
_SAMPLE = 200_000  # readings that are searched for rounding


@dataclass(frozen=True)
class SensorNoise:
    """Noise of the gyroscope (unit rad/s) or the accelerometer (m/s^2). axes: fit of each axis; together: one fit to
    the mean spectrum of the three axes.

    instability (3,): bias instability of each axis, in `unit`; instability_tau (3,): averaging time of the lowest Allan
    deviation [s]; open: True if this is the longest or shortest averaging time, so that the instability is only an
    upper bound.
    """

    kind: str
    unit: str
    axes: tuple[AllanFit, ...]
    together: AllanFit
    deviation: Deviation
    instability: np.ndarray
    instability_tau: np.ndarray
    open: tuple[bool, ...]


@dataclass(frozen=True)
class ImuNoiseStudy:
    """Result of `study_imu`. where: source of the readings, for messages; seconds: length of the readings at rest;
    period of the readings [s]; warnings, notes: sentences."""

    name: str
    where: str
    seconds: float
    period: float
    gyro: SensorNoise
    accel: SensorNoise
    warnings: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def sensors(self) -> tuple[SensorNoise, SensorNoise]:
        return self.gyro, self.accel


def study_recording(
    path: str | Path, imu: str | None = None, gyro_unit: GyroUnit | None = None, accel_unit: AccelUnit | None = None
) -> ImuNoiseStudy:
    """Noise of the IMU at `imu` (topic or table) in the recording; None: the only one. gyro_unit, accel_unit: units of
    the recorded readings; None: SI units, or g, which is recognised.

    Raises RecordingError if the readings are missing or wrong, EstimationError if the IMU was not at rest for 10 s.
    """
    recording: Recording = open_recording(path)
    name, source = _imu_source(str(path), recording, imu)
    sensor = ImuSensor(
        name, source, class_noise(DEFAULT_CLASS), topic=source, accel_unit=accel_unit, gyro_unit=gyro_unit
    )
    jumps = ClockJumps()
    stream, notes = read_imu(recording, sensor, jumps.cut)
    return study_imu(stream, recording.where(sensor), recording.notes() + jumps.notes + notes)


def study_imu(imu: ImuStream, where: str, notes: tuple[str, ...] = ()) -> ImuNoiseStudy:
    """Noise densities, bias walks and Allan deviations of `imu`; where, notes: for the result. Raises EstimationError
    if the IMU was not at rest for 10 s, or an axis never changes."""
    _refuse_constant(imu.name, np.concatenate([imu.gyro, imu.accel], axis=1))
    still = still_readings(imu)
    _refuse_constant(imu.name, still.readings)
    gyro = _sensor_noise("gyroscope", "rad/s", [part[:, :3] for part in still.stretches], still.period)
    accel = _sensor_noise("accelerometer", "m/s^2", [part[:, 3:] for part in still.stretches], still.period)
    rounding = _rounding(gyro.kind, still.readings[:, :3]) + _rounding(accel.kind, still.readings[:, 3:])
    warnings = still.warnings + _unit_warnings(gyro.together.white, accel.together.white) + rounding
    for sensor in (gyro, accel):
        warnings += _walk_warnings(sensor, still.seconds) + _shape_warnings(sensor)
    return ImuNoiseStudy(imu.name, where, still.seconds, still.period, gyro, accel, warnings, notes)


def _imu_source(where: str, recording: Recording, name: str | None) -> tuple[str, str | TwoSources]:
    """Name and source: the topic or table `name`, else the only one with readings of an IMU. If gyroscope and
    accelerometer have a topic or table each, both. Raises RecordingError with a list of the topics."""
    topics = recording.topics()
    pair = pair_of(recording, topics)
    if name is not None:
        topic = find_topic(where, topics, name)
        if topic.kind != "imu" or not topic.count:
            raise RecordingError(f"{where}: {name} holds no readings of an IMU; {listing(topics)}; correct --imu.")
        return name, pair if pair and topic.name in both(pair) else topic.name
    imus = [t for t in topics if t.kind == "imu" and t.count]
    if not imus:
        raise RecordingError(f"{where} has no readings of an IMU; {listing(topics)}; record one at rest.")
    if len(imus) == 2 and pair:
        return pair.gyro, pair
    if len(imus) > 1:
        raise RecordingError(f"{where} has several IMUs, {', '.join(t.name for t in imus)}; give one as --imu.")
    return imus[0].name, imus[0].name


def _sensor_noise(kind: str, unit: str, stretches: list[np.ndarray], period: float) -> SensorNoise:
    """Fits of one sensor. kind, unit: see `SensorNoise`; stretches: readings (n, 3) at rest, one every `period` s."""
    bands = [bands_of_all([part[:, k] for part in stretches], period) for k in range(3)]
    deviation = allan_deviation_of_all(stretches, period)
    instability, tau = deviation.instability()
    ends = deviation.tau[[0, -1]]
    return SensorNoise(
        kind=kind,
        unit=unit,
        axes=tuple(fit_noise(b, period) for b in bands),
        together=fit_noise(pooled(bands), period),
        deviation=deviation,
        instability=instability,
        instability_tau=tau,
        open=tuple(bool(t in ends) for t in tau),
    )


def _refuse_constant(name: str, readings: np.ndarray) -> None:
    """Raises EstimationError if an axis of the readings (n, 6) never changes: its noise has no spectrum."""
    constant = np.flatnonzero(np.ptp(readings, axis=0) == 0)
    if len(constant):
        axis = f"{('gyroscope', 'accelerometer')[constant[0] // 3]} {AXES[constant[0] % 3]}"
        raise EstimationError(
            f"{name}: the {axis} is {readings[0, constant[0]]:g} in all readings at rest, so its noise is unknown; "
            "check the driver, set a narrower range, or record more digits."
        )


def _unit_warnings(gyro: float, accel: float) -> tuple[str, ...]:
    """A warning if the gyroscope's readings are probably in deg/s. gyro [rad/s/sqrt(Hz)] and accel [m/s^2/sqrt(Hz)] are
    noise densities; only that of the gyroscope is far above its class."""
    usual = class_noise(DEFAULT_CLASS)
    times_gyro, times_accel = gyro / usual.gyro, accel / usual.accel
    if gyro < _NOISIEST_GYRO or times_gyro < _APART * times_accel:
        return ()
    return (
        f"the angular rates look like deg/s: at rest their noise is {times_gyro:.0f} times that of a "
        f"{DEFAULT_CLASS} gyroscope, that of the accelerometer {times_accel:.2g} times. If they are, give "
        f"--gyro-unit deg/s; the noise is then {gyro * DEGREE:.2g} rad/s/sqrt(Hz), not {gyro:.2g}.",
    )


def _walk_warnings(sensor: SensorNoise, seconds: float) -> tuple[str, ...]:
    fit, unit = sensor.together, f"{sensor.unit[:-2]}/s^2" if sensor.unit == "rad/s" else "m/s^3"
    if fit.lacking <= _WALK_KNOWN:
        return ()
    known = f"its standard deviation is {fit.walk_std / fit.walk:.0%}" if fit.resolved else "none is visible"
    factor = f"{fit.lacking:.2g}" if fit.lacking < 1e6 else "a million"
    at_least = "" if fit.resolved else "at least "
    return (
        f"{seconds:.0f} s are too short for the bias walk of the {sensor.kind}: {known}, and it may be up to "
        f"{fit.walk_upper:.2g} {unit}/sqrt(Hz). To know it to 20 %, record {at_least}{factor} times as long.",
    )


def _shape_warnings(sensor: SensorNoise) -> tuple[str, ...]:
    warnings: tuple[str, ...] = ()
    for axis, fit in zip(AXES, sensor.axes, strict=True):
        if fit.white > _WORSE * sensor.together.white:
            ratio = fit.white / sensor.together.white
            warnings += (f"the {sensor.kind} {axis} is {ratio:.1f} times as noisy as the mean of the axes.",)
    if sensor.together.misfit > _MISFIT:
        warnings += (
            f"the {sensor.kind} has more than white noise and a random walk: its spectrum departs from their "
            f"sum by {sensor.together.misfit:.0%}, which the standard deviations include; look for a slow "
            "drift (temperature) or vibration in the plot.",
        )
    return warnings


def _rounding(kind: str, readings: np.ndarray) -> tuple[str, ...]:
    """A warning if the steps of rounding in readings (n, 3) are larger than their noise."""
    part = readings[:_SAMPLE]
    for axis, values in zip(AXES, part.T, strict=True):
        levels = np.unique(values)
        noise = float(np.diff(values).std() / np.sqrt(2.0))
        step = float(np.median(np.diff(levels))) if len(levels) > 1 else 0.0
        if step > noise and len(levels) < _levels_of_noise(values, step):
            return (
                f"the {kind} {axis} is quantised in steps of {step:.2g}, more than its noise between readings, "
                "so its density is that of the quantisation; set a narrower range, or read more digits.",
            )
    return ()


def _levels_of_noise(values: np.ndarray, step: float) -> float:
    """Number of levels that values rounded to `step` can have within their range, and one more. If there are more, the
    values are not rounded."""
    return float(np.ptp(values) / step) + 2.0


_PER_DECADE = 10  # averaging times
_STARTS_PER_CLUSTER = 16  # overlapping pairs per averaging time: more of them add no information
_FLICKER = np.sqrt(2.0 * np.log(2.0) / np.pi)  # 0.664: ratio of the flat part of the deviation to the bias instability


@dataclass(frozen=True)
class Deviation:
    """Allan deviations of k axes. tau (m,): averaging times [s]; deviation (m, k), in the unit of the readings;
    relative (m,): relative standard deviation of `deviation`."""

    tau: np.ndarray
    deviation: np.ndarray
    relative: np.ndarray

    def instability(self) -> tuple[np.ndarray, np.ndarray]:
        """Bias instability (k,), the lowest deviation over 0.664, in the unit of the readings; and its averaging time
        (k,) [s]."""
        lowest = np.argmin(self.deviation, axis=0)
        return self.deviation[lowest, np.arange(self.deviation.shape[1])] / _FLICKER, self.tau[lowest]


def allan_deviation(readings: np.ndarray, period: float) -> Deviation:
    """Allan deviation of readings (n, k), one every `period` seconds; averaging times up to a quarter of the
    recording."""
    return allan_deviation_of_all([readings], period)


def allan_deviation_of_all(stretches: Sequence[np.ndarray], period: float) -> Deviation:
    """Allan deviation of several stretches of readings (n, k), one every `period` seconds. No difference of means spans
    two stretches, and all differences have equal weight. Averaging times are up to a quarter of the longest stretch."""
    longest = max(1, max(map(len, stretches)) // 4)
    sizes = np.unique(np.round(np.geomspace(1, longest, 1 + round(_PER_DECADE * np.log10(longest)))).astype(np.int64))
    angles = [np.concatenate([np.zeros((1, r.shape[1])), np.cumsum(r - r.mean(axis=0), axis=0)]) for r in stretches]
    variance = np.array([_variance(angles, int(m)) for m in sizes])
    pairs = sum(np.maximum(len(r) / sizes - 1.0, 0.0) for r in stretches)
    return Deviation(sizes * period, np.sqrt(variance), 1.0 / np.sqrt(2.0 * np.maximum(pairs, 1.0)))


def _variance(angles: Sequence[np.ndarray], m: int) -> np.ndarray:
    """(k,) Allan variance: half the mean square of the differences between successive means of m readings. angles:
    cumulative sums (n + 1, k) of each stretch."""
    step = max(1, m // _STARTS_PER_CLUSTER)
    long = [angle for angle in angles if len(angle) > 2 * m]
    second = np.concatenate([a[2 * m :: step] - 2.0 * a[m:-m:step] + a[: -2 * m : step] for a in long])
    return (second**2).mean(axis=0) / (2.0 * m**2)


def model_variance(white: float, walk: float, tau: np.ndarray, period: float) -> np.ndarray:
    """Allan variance at `tau` [s] of white noise of density N = `white` and a random walk of density K = `walk`,
    sampled every `period` seconds: N^2 / tau + K^2 tau / 3 (1 + (period / tau)^2 / 2)."""
    return white**2 / tau + walk**2 * tau / 3.0 * (1.0 + 0.5 * (period / tau) ** 2)


_GAP_PERIODS = 5.0  # periods: a longer interval between stamps is a gap, a shorter one is jitter of the stamps
_MOST_FILLED = 0.05  # share of missing readings: beyond it, stamps come in bursts and do not show gaps
_WINDOW_S = 1.0  # window in which the noise is computed; longer gaps are not filled
_LEAST_S = 10.0  # shortest usable length of the longest stretch at rest
_JUMP = np.repeat([0.02, 0.2], 3)  # rad/s, m/s^2: more change of the mean between windows is motion, not bias walk
_SURE = 8.0  # standard deviations of a window's mean: the same limit for noisy sensors
_OFF_RAD_S = 0.1  # a mean rate further from the median is motion; biases do not walk that far in hours
_LOUDER, _SCATTERS = 1.5, 3.0  # limit of the noise at rest: factor on the quietest, and standard deviations of its log
_QUIET = 2.0  # windows below this factor times the quietest noise give its scatter
_SHORTEST = 0.25  # of the longest stretch: shorter stretches have little information on slow noise
_GLITCH, _ALONE = 15.0, 5.0  # distance of a glitch from its neighbours' mean: over the median's, over that of near ones
_NEAR = 3  # readings on each side that are near
_READING = 200_000  # readings from which the step of rounding is found


@dataclass(frozen=True)
class Still:
    """Readings at rest. stretches: arrays (n, 6), gyroscope [rad/s] then accelerometer [m/s^2], one every `period`
    seconds; warnings: sentences."""

    stretches: tuple[np.ndarray, ...]
    period: float
    warnings: tuple[str, ...]

    @property
    def readings(self) -> np.ndarray:
        """(n, 6) readings of all stretches, concatenated."""
        return np.concatenate(self.stretches)

    @property
    def seconds(self) -> float:
        return sum(len(part) for part in self.stretches) * self.period


def still_readings(imu: ImuStream) -> Still:
    """The longest stretches of `imu` at rest, evenly sampled; warnings name readings that were filled or left out.

    Each window of a second is compared with the noise of the quietest 10 s. Raises EstimationError if the IMU was not
    at rest for 10 s.
    """
    readings, glitches = _without_glitches(np.concatenate([imu.gyro, imu.accel], axis=1), imu.name)
    parts, begins, period, gaps = _even(imu.name, imu.stamps_ns, readings)
    warnings = glitches + gaps
    window = max(1, round(_WINDOW_S / period))
    runs = [(k, *run) for k, moved in enumerate(_disturbed(parts, window)) for run in true_runs(~moved)]
    longest = max((last - first for _, first, last in runs), default=0)
    total = sum(len(part) for part in parts) * period
    if longest * window * period < _LEAST_S:
        raise EstimationError(
            f"{imu.name} was not at rest for {_LEAST_S:g} s anywhere in {total:.0f} s; put it on a table or "
            "the floor, touch nothing, and record again."
        )
    if [(k, 0, len(parts[k]) // window) for k in range(len(parts))] == runs and len(parts) == 1:
        return Still(tuple(parts), period, warnings)
    kept = [run for run in runs if run[2] - run[1] >= _SHORTEST * longest]
    named = [((last - first) * window * period, begins[k] + first * window * period) for k, first, last in kept]
    stretches = tuple(parts[k][first * window : last * window] for k, first, last in kept)
    why = "was moved or touched" if len(parts) == 1 else "was moved or touched, or has gaps of more than a second"
    return Still(stretches, period, (*warnings, f"{imu.name} {why}; {_what_is_used(total, named)}"))


def _what_is_used(total_s: float, stretches: list[tuple[float, float]]) -> str:
    """End of a warning: which part of `total_s` is used. stretches: length and begin of each [s]."""
    if len(stretches) == 1:
        long, begin = stretches[0]
        return f"only the longest stretch at rest of {total_s:.0f} s is used, {long:.0f} s from {begin:.0f} s on."
    listed = ", ".join(f"{long:.0f} s from {begin:.0f} s on" for long, begin in stretches)
    used_s = sum(long for long, _ in stretches)
    return (
        f"only the {len(stretches)} longest stretches at rest of {total_s:.0f} s are used, {used_s:.0f} s in "
        f"total: {listed}."
    )


def _without_glitches(readings: np.ndarray, name: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """`readings` (n, 6) in which glitches, single readings far off both neighbours, are replaced by the mean of these;
    and a warning with their number."""
    is_glitch = np.zeros(readings.shape, bool)
    step = _rounding_step([readings])
    for k, values in enumerate(readings.T if len(readings) >= 2 * _NEAR else ()):
        off = np.abs(values[1:-1] - 0.5 * (values[:-2] + values[2:]))
        usual = 1.4826 * float(np.median(off)) + step[k]
        padded = np.pad(off, _NEAR)  # the neighbours of a glitch, whose `off` is half of the glitch's, are not compared
        near = np.zeros(len(off))
        for j in (-3, -2, 2, 3):
            np.maximum(near, padded[_NEAR + j : len(padded) - _NEAR + j], out=near)
        step_size = np.abs(values[2:] - values[:-2])  # large if the IMU is tilted, small about a glitch
        is_glitch[1:-1, k] = off > np.maximum(_GLITCH * usual, _ALONE * np.maximum(near, step_size))
    if not is_glitch.any():
        return readings, ()
    at, axis = np.nonzero(is_glitch)
    repaired = readings.copy()
    repaired[at, axis] = 0.5 * (readings[at - 1, axis] + readings[at + 1, axis])
    return repaired, (f"{int(is_glitch.any(axis=1).sum())} readings of {name} are outliers and were removed.",)


def _even(
    name: str, stamps_ns: np.ndarray, readings: np.ndarray
) -> tuple[list[np.ndarray], list[float], float, tuple[str, ...]]:
    """Splits readings (n, 6) at gaps longer than a window, and fills shorter gaps by linear interpolation. Returns the
    parts, the begin of each since the first stamp [s], the period [s], and warnings."""
    steps = np.diff(stamps_ns) * 1e-9
    longest = max(_WINDOW_S, _GAP_PERIODS * float(np.median(steps)))
    cuts = np.flatnonzero(steps > longest) + 1
    begins = [0.0, *((stamps_ns[cuts] - stamps_ns[0]) * 1e-9).tolist()]
    joined = steps[steps <= longest]
    gap = joined > _GAP_PERIODS * np.median(steps)
    period = float(joined[~gap].mean())
    missing = np.where(gap, np.maximum(np.round(joined / period) - 1, 0), 0).astype(np.int64)
    if missing.sum() > _MOST_FILLED * len(readings):
        sentence = f"the stamps of {name} come in bursts, or with many gaps; its readings are treated as evenly spaced."
        return np.split(readings, cuts), begins, float(joined.mean()), (sentence,)
    if not missing.any():
        return np.split(readings, cuts), begins, period, ()
    parts = np.split(readings, cuts)
    missing_by_part = np.split(missing, np.cumsum([len(part) - 1 for part in parts])[:-1])
    filled = [_filled(part, count) for part, count in zip(parts, missing_by_part, strict=True)]
    sentence = (
        f"{name} has {int(gap.sum())} gaps, the longest of {joined.max():.3g} s; {int(missing.sum())} of "
        f"{sum(map(len, filled))} readings were interpolated linearly."
    )
    return filled, begins, period, (sentence,)


def _filled(readings: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """readings (n, 6) with missing (n - 1,) interpolated readings inserted after each."""
    at = np.concatenate([[0], np.cumsum(1 + missing)])
    every = np.arange(at[-1] + 1)
    return np.stack([np.interp(every, at, readings[:, k]) for k in range(6)], axis=1)


def _disturbed(parts: list[np.ndarray], window: int) -> list[np.ndarray]:
    """For each part (m,) bool: whether the IMU moved in each of its m windows, or vibrated in the window before or
    after. window: readings per window."""
    windows = [part[: len(part) // window * window].reshape(-1, window, 6) for part in parts]
    means = [w.mean(axis=1) for w in windows]
    floor = 0.5 * _rounding_step(parts)
    noises = [np.hypot(w.std(axis=1), floor) for w in windows]
    limits = _limits(windows, noises)
    if limits is None:
        return [np.ones(len(n), bool) for n in noises]
    quietest, loudest = limits
    jump = np.maximum(_JUMP, _SURE * quietest / np.sqrt(window))
    middle = np.nanmedian(np.where(np.concatenate(noises) <= loudest, np.concatenate(means), np.nan), axis=0)[:3]
    disturbed = []
    for mean, noise in zip(means, noises, strict=True):
        loud = np.pad(np.any(noise > loudest, axis=1), 1)
        loud = loud[:-2] | loud[1:-1] | loud[2:]  # the windows before and after, too
        moved = (np.abs(np.diff(mean, axis=0, prepend=mean[:1])) > jump).any(axis=1)
        disturbed.append(loud | moved | (np.abs(mean[:, :3] - middle) > _OFF_RAD_S).any(axis=1))
    return disturbed


def _limits(windows: list[np.ndarray], noises: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    """Noise (6,) of the quietest 10 s, and the largest noise (6,) of a window at rest; None if no part has 10 s.
    windows: readings (m, window, 6) of each part; noises: standard deviations (m, 6)."""
    least = round(_LEAST_S / _WINDOW_S)
    runs = [
        (np.median(sliding_window_view(noise, least, axis=0), axis=-1), readings)
        for noise, readings in zip(noises, windows, strict=True)
        if len(noise) >= least
    ]
    if not runs:
        return None
    quietest = np.min([noise.min(axis=0) for noise, _ in runs], axis=0) + 1e-12
    scatter = _scatter(np.concatenate(noises), quietest)
    for axis in range(6):
        noise, readings = min(runs, key=lambda run: run[0][:, axis].min())
        at = int(noise[:, axis].argmin())
        scatter[axis] = min(scatter[axis], _scatter_of_noise(readings[at : at + least, :, axis]))
    return quietest, quietest * _LOUDER * np.exp(_SCATTERS * scatter)


def _scatter(noises: np.ndarray, quietest: np.ndarray) -> np.ndarray:
    """(6,) standard deviation of the logarithm of the noise of quiet windows, by the median absolute deviation.
    noises (m, 6), quietest (6,)."""
    quiet = np.log(np.where(noises <= _QUIET * quietest, noises, np.nan) / quietest)
    return 1.4826 * np.nanmedian(np.abs(quiet - np.nanmedian(quiet, axis=0)), axis=0)


def _scatter_of_noise(windows: np.ndarray) -> float:
    """Standard deviation of the logarithm of the noise of windows (m, window) at rest, by Bartlett's formula from their
    spectrum. It accounts for a filter, after which few readings of a window are independent."""
    power = np.abs(np.fft.rfft(windows.ravel() - windows.mean())[1:]) ** 2
    # Sum of the squared autocorrelation.
    squares = 0.5 * len(power) * float((power**2).sum()) / max(float(power.sum()) ** 2, 1e-300)
    return float(np.sqrt(0.5 * squares / windows.shape[1]))


def _rounding_step(parts: list[np.ndarray]) -> np.ndarray:
    """(6,) median step between the distinct values of the readings: the resolution of rounded ones."""
    ends = np.cumsum([len(part) for part in parts])
    sample = np.concatenate([part[:_READING] for part in parts[: 1 + int(np.searchsorted(ends, _READING))]])
    levels = (np.unique(values) for values in sample.T)
    return np.array([np.median(np.diff(v)) if len(v) > 1 else 0.0 for v in levels])


# White noise and random walk of a bias, by maximum likelihood of the differences of successive readings.
#
# With readings y_i = b_i + w_i, w white with variance N^2 / T and b a random walk with steps of variance K^2 T (T: the
# period), the differences have the covariance K^2 T I + N^2 / T tridiag(-1, 2, -1). The discrete sine transform (type
# I) makes it diagonal, so the likelihood is exact: coefficients z_k are independent, of variance
#
#     s_k = c + a (2 - 2 cos(pi k / (n + 1))),     a = N^2 / T,  c = K^2 T.
#
# Differences lose no information but the constant bias. Coefficients are averaged in frequency bands; the model is
# linear in (a, c).

_PER_OCTAVE = 8  # bands
_HIGHEST = 0.05  # highest frequency over the rate: above it, the sensor's filter and rounding shape the spectrum
_LEAST_IN_BAND = 8  # coefficients, which make the mean power of a band about Gaussian
_RESOLVED = 9.0  # twice the gain in log-likelihood by the walk: 3 sigma
_UPPER = 2.71  # twice the loss in log-likelihood at the upper bound: one-sided 95 %
_SURE_OF_MISFIT = 5.0  # chi^2 above its mean by this many standard deviations shows that the model does not fit
_RATIOS = np.concatenate([[0.0], np.geomspace(1e-16, 1e4, 401)])  # grid of c / a


@dataclass(frozen=True)
class Bands:
    """Power spectrum of the differences in j bands. frequency (j,): mean [Hz]; count (j,): number of coefficients;
    power (j,): their mean square; slope (j,): mean of 2 - 2 cos, the factor of a in the model."""

    frequency: np.ndarray
    count: np.ndarray
    power: np.ndarray
    slope: np.ndarray


@dataclass(frozen=True)
class AllanFit:
    """Fitted noise. white: density N [unit/sqrt(Hz)]; walk: density K [unit s^-1/sqrt(Hz)]; _std: standard deviations.

    resolved: whether the walk is significant (3 sigma). walk_upper: upper bound of K (95 %). misfit: relative standard
    deviation of the bands about the model, beyond their sampling noise; the standard deviations include it. lacking:
    factor by which the recording must be longer to know K to 20 %; below 1 it is long enough.
    """

    white: float
    white_std: float
    walk: float
    walk_std: float
    walk_upper: float
    resolved: bool
    misfit: float
    lacking: float


def bands_of_all(stretches: Sequence[np.ndarray], period: float) -> Bands:
    """Bands of several stretches of readings, each (n,), one every `period` seconds. The bands of all stretches are
    concatenated, as their likelihoods multiply. No difference spans two stretches."""
    bands = [bands_of(part, period) for part in stretches]
    return Bands(*(np.concatenate([getattr(b, f.name) for b in bands]) for f in fields(Bands)))


def bands_of(readings: np.ndarray, period: float) -> Bands:
    """Bands of readings (n,), one every `period` seconds, up to a frequency of a twentieth of the rate."""
    differences = np.diff(readings)
    n = _smooth_size(len(differences) + 1) - 1
    odd = np.concatenate([[0.0], differences[:n], [0.0], -differences[:n][::-1]])
    squares = (np.fft.rfft(odd).imag[1 : n + 1] / 2.0) ** 2 * 2.0 / (n + 1)
    last = max(3, int(2.0 * _HIGHEST * n))
    k = np.arange(1, last + 1)
    edges = np.unique(np.concatenate([[0], np.round(np.geomspace(1, last, 1 + int(_PER_OCTAVE * np.log2(last))))]))
    starts = edges[:-1].astype(np.int64)
    count = np.diff(edges)
    angle = np.pi * k / (n + 1)
    power, slope, middle = (np.add.reduceat(x, starts) / count for x in (squares[:last], _slope(angle), angle))
    return Bands(middle / (2.0 * np.pi * period), count, power, slope)


def pooled(axes: list[Bands]) -> Bands:
    """Mean spectrum of several axes; its a and c are the means of those of the axes. The effective `count` is smaller
    if the axes differ in power."""
    power = np.array([b.power for b in axes])
    weight = np.array([(b.power * b.count).sum() / b.count.sum() for b in axes])
    return Bands(axes[0].frequency, axes[0].count * weight.sum() ** 2 / (weight**2).sum(), power.mean(0), axes[0].slope)


def fit_noise(bands: Bands, period: float) -> AllanFit:
    """Maximum-likelihood N and K from `bands` of readings one every `period` seconds. The weights of the bands are
    reduced until the misfit is consistent with them."""
    misfit, weight = 0.0, 0.5 * bands.count
    ratio, a = _most_likely(bands, weight)
    for _ in range(20):
        new_misfit = _misfit(bands, a * (bands.slope + ratio))
        if abs(new_misfit - misfit) <= 0.01 * misfit:
            break
        misfit, weight = new_misfit, 1.0 / (2.0 / bands.count + new_misfit**2)
        ratio, a = _most_likely(bands, weight)
    floor = _cost(bands, weight, ratio)
    upper = _upper_ratio(bands, weight, ratio, floor)
    c = ratio * a
    std_a, std_c = _std(bands, weight, a, c)
    resolved = bool(2.0 * (_cost(bands, weight, 0.0) - floor) > _RESOLVED)
    known_c = c if resolved else upper * a
    relative = 0.5 * _std(bands, weight, a, known_c)[1] / known_c if known_c > 0 else np.inf
    walk = np.sqrt(c / period)
    return AllanFit(
        white=float(np.sqrt(a * period)),
        white_std=float(0.5 * std_a / a * np.sqrt(a * period)),
        walk=float(walk),
        walk_std=float(0.5 * std_c / c * walk) if c > 0 else float(np.sqrt(upper * a / period)),
        walk_upper=float(np.sqrt(upper * a / period)),
        resolved=resolved,
        misfit=float(misfit),
        lacking=float((relative / 0.2) ** 2),
    )


def _slope(angle: np.ndarray) -> np.ndarray:
    return 4.0 * np.sin(0.5 * angle) ** 2


def _cost(bands: Bands, weight: np.ndarray, ratio: float) -> float:
    """Negative log-likelihood at c / a = ratio, maximised over a."""
    shape = bands.slope + ratio
    a = (weight * bands.power / shape).sum() / weight.sum()
    return float((weight * np.log(a * shape)).sum())


def _most_likely(bands: Bands, weight: np.ndarray) -> tuple[float, float]:
    """c / a and a of the highest likelihood, by a grid search and then golden-section search."""
    costs = [_cost(bands, weight, float(r)) for r in _RATIOS]
    best = int(np.argmin(costs))
    low, high = (float(_RATIOS[min(max(best + side, 0), len(_RATIOS) - 1)]) for side in (-1, 1))
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    for _ in range(60):
        left, right = high - golden * (high - low), low + golden * (high - low)
        if _cost(bands, weight, left) < _cost(bands, weight, right):
            high = right
        else:
            low = left
    ratio = 0.0 if best == 0 else 0.5 * (low + high)
    return ratio, float((weight * bands.power / (bands.slope + ratio)).sum() / weight.sum())


def _upper_ratio(bands: Bands, weight: np.ndarray, ratio: float, floor: float) -> float:
    """Upper bound (95 %) of c / a on the grid, from the likelihood ratio. ratio, floor: estimate and its cost."""
    for r in _RATIOS[np.searchsorted(_RATIOS, ratio, "right") :]:
        if 2.0 * (_cost(bands, weight, float(r)) - floor) > _UPPER:
            return float(r)
    return float(_RATIOS[-1])


def _std(bands: Bands, weight: np.ndarray, a: float, c: float) -> tuple[float, float]:
    """Standard deviations of a and c, from the Fisher information."""
    variance = c + a * bands.slope
    gradient = np.stack([bands.slope, np.ones_like(bands.slope)], axis=1) / variance[:, None]
    covariance = np.linalg.inv(gradient.T @ (weight[:, None] * gradient))
    return float(np.sqrt(covariance[0, 0])), float(np.sqrt(covariance[1, 1]))


def _misfit(bands: Bands, variance: np.ndarray) -> float:
    """Relative standard deviation of the bands about the model `variance` (j,), beyond their sampling noise; 0 if chi^2
    is as expected."""
    wide = bands.count >= _LEAST_IN_BAND
    off = (bands.power[wide] / variance[wide] - 1.0) ** 2
    noise, dof = 2.0 / bands.count[wide], max(1, int(wide.sum()) - 2)
    # The mean of m squares has an excess kurtosis of 12 / m, so that its whitened square has the variance 2 + 12 / m.
    if (off / noise).sum() < dof + _SURE_OF_MISFIT * np.sqrt((2.0 + 6.0 * noise).sum()):
        return 0.0
    low, high = 0.0, 10.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if (off / (noise + middle**2)).sum() > dof else (low, middle)
    return 0.5 * (low + high)


def _smooth_size(n: int) -> int:
    """The largest number up to n without a prime factor above 5: an FFT of this size is fast."""
    best = 1
    five = 1
    while five <= n:
        three = five
        while three <= n:
            best = max(best, three << ((n // three).bit_length() - 1))
            three *= 3
        five *= 5
    return best
