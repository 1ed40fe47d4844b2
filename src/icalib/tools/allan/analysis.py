"""Estimates the noise of an IMU from a recording at rest, and warns of wrong units, rounding and short recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from icalib.data.measurements import ImuStream
from icalib.data.recordings import BagRecording, Recording, TopicInfo, open_recording
from icalib.data.stamps.jumps import ClockJumps
from icalib.data.topics import find_topic, listing
from icalib.errors import RecordingError
from icalib.rig import AccelUnit, GyroUnit, ImuSensor
from icalib.sensors.imu.read import read_imu
from icalib.sensors.imu.read.halves import pair_of
from icalib.sensors.imu.read.units import DEGREE
from icalib.sensors.imu.spec import DEFAULT_CLASS, class_noise
from icalib.tools.allan.deviation import Deviation, allan_deviation_of_all
from icalib.tools.allan.fit import AllanFit, bands_of_all, fit_noise, pooled
from icalib.tools.allan.sampling import still_readings

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
    topic = _imu_topic(str(path), recording, imu)
    sensor = ImuSensor(
        topic.name, topic.name, class_noise(DEFAULT_CLASS), topic=topic.name, accel_unit=accel_unit, gyro_unit=gyro_unit
    )
    jumps = ClockJumps()
    stream, notes = read_imu(recording, sensor, jumps.cut)
    return study_imu(stream, recording.where(sensor), recording.notes() + jumps.notes + notes)


def study_imu(imu: ImuStream, where: str, notes: tuple[str, ...] = ()) -> ImuNoiseStudy:
    """Noise densities, bias walks and Allan deviations of `imu`; where, notes: for the result. Raises EstimationError
    if the IMU was not at rest for 10 s."""
    still = still_readings(imu)
    gyro = _sensor_noise("gyroscope", "rad/s", [part[:, :3] for part in still.stretches], still.period)
    accel = _sensor_noise("accelerometer", "m/s^2", [part[:, 3:] for part in still.stretches], still.period)
    rounding = _rounding(gyro.kind, still.readings[:, :3]) + _rounding(accel.kind, still.readings[:, 3:])
    warnings = still.warnings + _unit_warnings(gyro.together.white, accel.together.white) + rounding
    for sensor in (gyro, accel):
        warnings += _walk_warnings(sensor, still.seconds) + _shape_warnings(sensor)
    return ImuNoiseStudy(imu.name, where, still.seconds, still.period, gyro, accel, warnings, notes)


def _imu_topic(where: str, recording: Recording, name: str | None) -> TopicInfo:
    """The topic or table `name`, else the only one with readings of an IMU. If gyroscope and accelerometer have a
    topic each, one of the two. Raises RecordingError with a list of the topics."""
    topics = recording.topics()
    if name is not None:
        topic = find_topic(where, topics, name)
        if topic.kind != "imu" or not topic.count:
            raise RecordingError(f"{where}: {name} holds no readings of an IMU; {listing(topics)}; correct --imu.")
        return topic
    imus = [t for t in topics if t.kind == "imu" and t.count]
    if not imus:
        raise RecordingError(f"{where} has no readings of an IMU; {listing(topics)}; record one at rest.")
    pair = len(imus) == 2 and isinstance(recording, BagRecording) and pair_of(recording, topics)
    if len(imus) > 1 and not pair:
        raise RecordingError(f"{where} has several IMUs, {', '.join(t.name for t in imus)}; give one as --imu.")
    return imus[0]


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
