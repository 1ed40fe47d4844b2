"""Checks that an IMU's stream is plausible in rad/s, m/s^2 and ns, and removes wrong readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import ImuStream
from icalib.data.stamps.ordered import kept_readings, longest_run
from icalib.errors import RecordingError
from icalib.rig import ImuSensor
from icalib.sensors.imu.read.cleaning import in_time, without_wrong
from icalib.sensors.imu.read.table_kinds import RATE_HZ
from icalib.sensors.imu.read.units import in_si, recognised_unit

_SATURATED_RUN = 5  # equal readings in a row at the extreme of an axis
# [rad/s], [m/s^2]. No sensor's range is narrower (125 deg/s, 2 g); equal readings below it are coarse quantisation.
_NARROWEST_RANGE = {"gyroscope": 2.0, "accelerometer": 17.0}


@dataclass(frozen=True)
class Saturation:
    """Run of `count` readings equal to `limit` [rad/s or m/s^2] from stamp_ns on; kind: gyroscope or accelerometer."""

    kind: str
    axis: str  # x, y or z
    limit: float
    count: int
    stamp_ns: int


def checked_imu(imu: ImuStream, where: str, sensor: ImuSensor | None = None) -> tuple[ImuStream, tuple[str, ...]]:
    """`imu` with strictly increasing stamps in SI units; notes on dropped, converted and possibly saturated readings.
    `sensor` has the units and axes of the readings as stated in the rig file; None: they are recognised.

    Outliers and copies of readings are dropped. Jittering stamps of evenly sampled readings are replaced by even ones.

    Raises RecordingError that names `where` (the file) and the instant: too few readings, stamps out of order,
    different readings at one stamp, a frozen sensor, or wrong units of time, angular rate or acceleration.
    """
    what = f"{where} ({imu.name})"
    if len(imu.stamps_ns) < 2:
        raise RecordingError(f"{what}: only {len(imu.stamps_ns)} reading; a calibration needs the whole recording.")
    imu, timed = in_time(imu, what)
    if len(imu.stamps_ns) < 2:
        raise RecordingError(f"{what}: no two readings are finite; check the driver, and record again.")
    values, remedy = np.hstack([imu.gyro, imu.accel]), "export the IMU's own stamps"
    kept, notes = kept_readings(imu.stamps_ns, values, what, RATE_HZ, "reading", remedy)
    if notes:
        imu = ImuStream(imu.name, imu.stamps_ns[kept], imu.gyro[kept], imu.accel[kept])
    _refuse_frozen(imu, what)
    imu, rejected = without_wrong(imu, what)
    imu, converted = recognised_unit(imu if sensor is None else in_si(imu, sensor), what, sensor)
    return imu, timed + notes + rejected + converted + _saturation_notes(imu, what)


def _refuse_frozen(imu: ImuStream, what: str) -> None:
    for kind, values in (("gyroscope", imu.gyro), ("accelerometer", imu.accel)):
        if (values == values[0]).all():
            raise RecordingError(f"{what}: the {kind} gives the same reading from start to end; check its driver.")


def _saturation_notes(imu: ImuStream, what: str) -> tuple[str, ...]:
    return tuple(
        f"{what}: the {s.kind} {s.axis} looks saturated, {s.count} readings in a row at {s.limit:.4g} from "
        f"{s.stamp_ns} ns on; move more slowly, or set a wider range."
        for s in saturations(imu)
    )


def saturations(imu: ImuStream) -> tuple[Saturation, ...]:
    """The longest run of readings at the largest and at the smallest value of each axis, if it looks saturated."""
    runs: list[Saturation] = []
    for kind, values in (("gyroscope", imu.gyro), ("accelerometer", imu.accel)):
        for axis, name in enumerate("xyz"):
            for limit in (values[:, axis].max(), values[:, axis].min()):
                at, count = longest_run(values[:, axis] == limit)
                if abs(limit) >= _NARROWEST_RANGE[kind] and count >= _SATURATED_RUN:
                    runs.append(Saturation(kind, name, float(limit), count, int(imu.stamps_ns[at])))
    return tuple(runs)
