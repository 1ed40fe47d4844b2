"""Is this an IMU's stream in rad/s, m/s^2 and nanoseconds?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.errors import RecordingError
from icalib.measurements import ImuStream
from icalib.recordings.ordered import kept_readings, longest_run

_RATE_HZ = (10.0, 20_000.0)
_FASTEST_RAD_S = 35.0  # 2000 deg/s, the widest range of common gyroscopes
_G_UNITS = (0.5, 2.0)  # of the median |accel|: a reading of gravity in units of g
_GRAVITY_M_S2 = (5.0, 20.0)
_SATURATED_RUN = 5
# No sensor's range is narrower (125 deg/s, 2 g); below it, equal readings are coarse quantisation, not saturation.
_NARROWEST_RANGE = {"gyroscope": 2.0, "accelerometer": 17.0}


@dataclass(frozen=True)
class Saturation:
    """count readings in a row at `limit` [rad/s or m/s^2] from stamp_ns on; kind: gyroscope or accelerometer."""

    kind: str
    axis: str  # x, y or z
    limit: float
    count: int
    stamp_ns: int


def checked_imu(imu: ImuStream, where: str) -> tuple[ImuStream, tuple[str, ...]]:
    """`imu` with strictly increasing stamps, and notes on what was dropped or looks saturated.

    Raises RecordingError naming `where` (the file) and the instant: too few readings, NaN, stamps out of order or
    repeated with other values, a frozen sensor, other units of time, angular rate or acceleration.
    """
    what = f"{where} ({imu.name})"
    if len(imu.stamps_ns) < 2:
        raise RecordingError(f"{what}: only {len(imu.stamps_ns)} reading; a calibration needs the whole recording.")
    values, own = np.hstack([imu.gyro, imu.accel]), "export the IMU's own stamps"
    kept, notes = kept_readings(imu.stamps_ns, values, what, _RATE_HZ, "reading", own)
    if notes:
        imu = ImuStream(imu.name, imu.stamps_ns[kept], imu.gyro[kept], imu.accel[kept])
    _refuse_units(imu, what)
    return imu, notes + _saturation_notes(imu, what)


def _refuse_units(imu: ImuStream, what: str) -> None:
    for kind, values in (("gyroscope", imu.gyro), ("accelerometer", imu.accel)):
        if (values == values[0]).all():
            raise RecordingError(f"{what}: the {kind} gives the same reading from start to end; check its driver.")
    gravity = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    if _G_UNITS[0] <= gravity <= _G_UNITS[1]:
        raise RecordingError(
            f"{what}: the median |accel| is {gravity:.3g}, which looks like units of g; "
            "multiply by 9.80665 to get m/s^2."
        )
    if not _GRAVITY_M_S2[0] <= gravity <= _GRAVITY_M_S2[1]:
        raise RecordingError(
            f"{what}: the median |accel| is {gravity:.3g}, far from gravity, 9.81 m/s^2; the columns must be t [ns], "
            "gyroscope x, y, z [rad/s], accelerometer x, y, z [m/s^2], gravity included."
        )
    fast = float(np.percentile(np.linalg.norm(imu.gyro, axis=1), 99))
    if fast > _FASTEST_RAD_S:
        raise RecordingError(
            f"{what}: the angular rate reaches {fast:.3g}, more than any hand or robot turns in rad/s; "
            "it looks like deg/s; multiply by pi / 180."
        )


def _saturation_notes(imu: ImuStream, what: str) -> tuple[str, ...]:
    return tuple(
        f"{what}: the {s.kind} {s.axis} looks saturated, {s.count} readings in a row at {s.limit:.4g} "
        f"from {s.stamp_ns} ns on; move less quickly or set a wider range."
        for s in saturations(imu)
    )


def saturations(imu: ImuStream) -> tuple[Saturation, ...]:
    """Where readings sit at the largest or smallest value of their axis, the longest run of each."""
    found: list[Saturation] = []
    for kind, values in (("gyroscope", imu.gyro), ("accelerometer", imu.accel)):
        for axis, name in enumerate("xyz"):
            for limit in (values[:, axis].max(), values[:, axis].min()):
                at, count = longest_run(values[:, axis] == limit)
                if abs(limit) >= _NARROWEST_RANGE[kind] and count >= _SATURATED_RUN:
                    found.append(Saturation(kind, name, float(limit), count, int(imu.stamps_ns[at])))
    return tuple(found)
