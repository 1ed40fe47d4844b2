"""From a recording of an IMU at rest to its noise."""

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
_WALK_KNOWN = 1.0  # of NoiseFit.lacking
_WORSE = 1.5  # times the mean density
_MISFIT = 0.15
_NOISIEST_GYRO = 1e-3  # rad/s/sqrt(Hz): more than gyroscopes have that are sold; quiet ones have it in deg/s
_APART = 5.0  # times as far from its class as the accelerometer, which vibration would disturb as well
_SAMPLE = 200_000  # readings in which the steps of rounding are looked for


@dataclass(frozen=True)
class SensorNoise:
    """Noise of the gyroscope (unit rad/s) or the accelerometer (m/s^2). together: what all three axes are taken for.

    instability (3,) in `unit`, and the averaging time (3,) [s] where the deviation is lowest; open: where that is the
    longest or shortest averaging time, so that the instability is only bounded.
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
    """What `study_imu` found. warnings, notes: sentences."""

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
    """Of the IMU at `imu` (topic or table) in the recording; by default the only one. Units: of the readings as they
    are recorded; None: SI units, and g is recognised.

    Raises RecordingError as the readers do, and EstimationError where nothing stood still for 10 s.
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
    """Noise densities, bias walks and Allan deviations of `imu`. Raises EstimationError as `still_readings`."""
    still = still_readings(imu)
    gyro = _sensor_noise("gyroscope", "rad/s", [part[:, :3] for part in still.stretches], still.period)
    accel = _sensor_noise("accelerometer", "m/s^2", [part[:, 3:] for part in still.stretches], still.period)
    rounding = _rounding(gyro.kind, still.readings[:, :3]) + _rounding(accel.kind, still.readings[:, 3:])
    warnings = still.warnings + _unit_warnings(gyro.together.white, accel.together.white) + rounding
    for sensor in (gyro, accel):
        warnings += _walk_warnings(sensor, still.seconds) + _shape_warnings(sensor)
    return ImuNoiseStudy(imu.name, where, still.seconds, still.period, gyro, accel, warnings, notes)


def _imu_topic(where: str, recording: Recording, given: str | None) -> TopicInfo:
    """The topic or table `given`, else the only one of an IMU, or one of its two where its sensors report apart. Raises
    RecordingError listing what there is."""
    topics = recording.topics()
    if given is not None:
        topic = find_topic(where, topics, given)
        if topic.kind != "imu" or not topic.count:
            raise RecordingError(f"{where}: {given} holds no readings of an IMU; {listing(topics)}; correct --imu.")
        return topic
    found = [t for t in topics if t.kind == "imu" and t.count]
    if not found:
        raise RecordingError(f"{where} has no readings of an IMU; {listing(topics)}; record one at rest.")
    pair = len(found) == 2 and isinstance(recording, BagRecording) and pair_of(recording, topics)
    if len(found) > 1 and not pair:
        raise RecordingError(f"{where} has several IMUs, {', '.join(t.name for t in found)}; give one as --imu.")
    return found[0]


def _sensor_noise(kind: str, unit: str, stretches: list[np.ndarray], period: float) -> SensorNoise:
    """stretches: readings (n, 3) at rest."""
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
    """A warning where the noise of the gyroscope is that of one in deg/s beside the accelerometer's."""
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
    found: tuple[str, ...] = ()
    for axis, fit in zip(AXES, sensor.axes, strict=True):
        if fit.white > _WORSE * sensor.together.white:
            ratio = fit.white / sensor.together.white
            found += (f"the {sensor.kind} {axis} is {ratio:.1f} times as noisy as the mean of the axes.",)
    if sensor.together.misfit > _MISFIT:
        found += (
            f"the {sensor.kind} has more than white noise and a random walk: its spectrum departs from their "
            f"sum by {sensor.together.misfit:.0%}, which the standard deviations include; look for a slow "
            "drift (temperature) or vibration in the plot.",
        )
    return found


def _rounding(kind: str, readings: np.ndarray) -> tuple[str, ...]:
    """A warning where readings are rounded as coarsely as they are noisy."""
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
    """More levels than the range holds are no rounding."""
    return float(np.ptp(values) / step) + 2.0
