"""Statistics of an IMU's readings: ranges, units, and principal axes of the rotation."""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import ImuStream
from icalib.data.recordings import Recording
from icalib.data.stamps.jumps import ClockJumps
from icalib.errors import RecordingError
from icalib.rig import ImuSensor, TwoSources
from icalib.sensors.imu.inspect.facts import ImuFacts
from icalib.sensors.imu.read import readings
from icalib.sensors.imu.read.checks import checked_imu, saturations
from icalib.sensors.imu.read.gravity_turns import gravity_spread
from icalib.sensors.imu.read.halves import one_stream
from icalib.sensors.imu.scatter import quiet_scatter
from icalib.sensors.imu.spec import DEFAULT_CLASS, class_noise
from icalib.tools.inspection.facts import Vector

_DEGREE = np.pi / 180.0


def read_imu(recording: Recording, name: str, topic: str | TwoSources) -> tuple[ImuStream, str, tuple[str, ...]]:
    """The readings in recorded units, the name of their source for messages, and notes if two topics were joined.
    Raises RecordingError if they cannot be read."""
    sensor = ImuSensor(name, topic, class_noise(DEFAULT_CLASS), topic=topic)
    where = recording.where(sensor)
    imu, notes = one_stream(readings(recording, sensor), f"{where} ({name})")
    return imu, where, notes


def imu_facts(imu: ImuStream, where: str, frame: str, notes: tuple[str, ...] = ()) -> ImuFacts:
    """Statistics of `imu`; `problem` says why `calibrate` would refuse it. where: name of the source for messages;
    notes: to be put before those of this function."""
    problem, jumps = "", ClockJumps()
    try:
        imu, reading_notes = checked_imu(jumps.cut(imu, f"{where} ({imu.name})"), where)
        notes += jumps.notes + reading_notes
    except RecordingError as error:
        problem = str(error)
    finite = np.isfinite(imu.gyro).all(axis=1) & np.isfinite(imu.accel).all(axis=1)
    gyro, accel = (x[finite] if finite.any() else np.zeros((1, 3)) for x in (imu.gyro, imu.accel))
    # eigh sorts in ascending order; here the strongest direction comes first.
    squares, directions = np.linalg.eigh(gyro.T @ gyro / len(gyro))
    first, second, third = (_vector(d * np.sign(d[np.argmax(np.abs(d))])) for d in directions.T[::-1])
    return ImuFacts(
        frame=frame,
        gyro_min=_vector(gyro.min(axis=0)),
        gyro_max=_vector(gyro.max(axis=0)),
        accel_min=_vector(accel.min(axis=0)),
        accel_max=_vector(accel.max(axis=0)),
        mean_accel=float(np.linalg.norm(accel, axis=1).mean()),
        gyro_rms=_vector(np.sqrt((gyro**2).mean(axis=0))),
        accel_std=_vector(accel.std(axis=0)),
        principal_rms=_vector(np.sqrt(np.maximum(squares[::-1], 0.0))),
        principal=(first, second, third),
        gravity_spread=None if problem else _spreads(imu),
        scatter=(np.nan, np.nan)
        if problem
        else (quiet_scatter(imu.seconds, imu.gyro), quiet_scatter(imu.seconds, imu.accel)),
        saturated=saturations(imu) if finite.all() and len(imu.gyro) else (),
        notes=notes,
        problem=problem,
    )


def _spreads(imu: ImuStream) -> Vector | None:
    radians, degrees, none = (gravity_spread(imu, unit) for unit in (1.0, _DEGREE, 0.0))
    return None if radians is None or degrees is None or none is None else (radians, degrees, none)


def _vector(x: np.ndarray) -> Vector:
    return float(x[0]), float(x[1]), float(x[2])
