"""Converts readings of an IMU to SI units and the IMU frame, as stated in the rig file or as gravity shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.data.measurements import ImuStream
from icalib.data.tables.columns import in_axes
from icalib.errors import RecordingError
from icalib.rig import ImuSensor
from icalib.sensors.imu.read.gravity_turns import WINDOW_S, gravity_size

G_M_S2 = 9.80665
DEGREE = np.pi / 180.0
_FASTEST_RAD_S = 35.0  # 2000 deg/s, the widest range of common gyroscopes
_GRAVITY_M_S2 = (5.0, 20.0)  # plausible range of the median |accel|
_NEAR_ONE = (0.8, 1.25)  # range of gravity in units of g; scale errors of accelerometers are smaller
_STEADY = 0.75  # smallest ratio of lower to upper quartile over windows: gravity; about 0.5: linear acceleration
_MISSING = 0.5  # share of the median |accel|; a smaller gravity means that the readings contain none


def in_si(imu: ImuStream, sensor: ImuSensor) -> ImuStream:
    """The readings in SI units and the IMU frame, converted from the units and axes that the rig file states."""
    accel = G_M_S2 * imu.accel if sensor.accel_unit == "g" else imu.accel
    gyro = DEGREE * imu.gyro if sensor.gyro_unit == "deg/s" else imu.gyro
    return replace(imu, gyro=in_axes(gyro, sensor.gyro_axes), accel=in_axes(accel, sensor.accel_axes))


def recognised_unit(imu: ImuStream, what: str, sensor: ImuSensor | None) -> tuple[ImuStream, tuple[str, ...]]:
    """The readings with accelerations in m/s^2, and a note if gravity shows that they were in g.

    Raises RecordingError if the readings contain no gravity, or if the unit of acceleration or angular rate is wrong.
    """
    notes: tuple[str, ...] = ()
    median = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    if _is_in_g(imu, median):
        if sensor is not None and sensor.accel_unit is not None:
            raise RecordingError(
                f"{what}: with accel_unit: {sensor.accel_unit} the accelerometer measures gravity as "
                f"{median:.3g}, which looks like units of g; correct accel_unit in the rig file."
            )
        notes = (
            f"{what}: the accelerometer is in units of g (its median is {median:.3g}); its readings were "
            f"multiplied by {G_M_S2} m/s^2.",
        )
        imu = replace(imu, accel=G_M_S2 * imu.accel)
    elif _lacks_gravity(imu, median):
        raise RecordingError(
            f"{what}: the accelerometer readings contain no gravity (median |accel| {median:.3g} m/s^2; their "
            "mean, rotated by the gyroscope, is far below 9.81). The driver has removed it; record the raw "
            "accelerometer."
        )
    elif not _GRAVITY_M_S2[0] <= median <= _GRAVITY_M_S2[1]:
        raise RecordingError(
            f"{what}: the median |accel| is {median:.3g}, far from gravity, 9.81 m/s^2. The columns must be t "
            "[ns], gyroscope x, y, z [rad/s], accelerometer x, y, z [m/s^2] with gravity. Set accel_unit: g "
            "in the rig file for units of g."
        )
    _refuse_degrees(imu, what)
    return imu, notes


def _is_in_g(imu: ImuStream, median: float) -> bool:
    """True if gravity is about 1 in most windows. median: median |accel|. Linear acceleration alone is less steady."""
    if not _NEAR_ONE[0] <= median <= 1.5 * _NEAR_ONE[1]:
        return False
    sizes = [np.linalg.norm(imu.accel, axis=1)] if imu.seconds[-1] < WINDOW_S else _gravity(imu)
    quartiles = (np.quantile(size, [0.25, 0.75]) for size in sizes)
    return any(_NEAR_ONE[0] <= low and high <= _NEAR_ONE[1] for low, high in quartiles)


def _lacks_gravity(imu: ImuStream, median: float) -> bool:
    """True if the readings are near zero, or their mean over windows is far below their size or varies between windows.

    This must be so for every unit of the rates; median: median |accel|.
    """
    if median >= _GRAVITY_M_S2[0] or imu.seconds[-1] < WINDOW_S:
        return False
    quartiles = (np.quantile(size, [0.25, 0.5, 0.75]) for size in _gravity(imu))
    steady = any(low > _STEADY * high and middle > _MISSING * median for low, middle, high in quartiles)
    return median < _MISSING * _NEAR_ONE[0] or not steady


def _gravity(imu: ImuStream) -> list[np.ndarray]:
    """`gravity_size` for rates in rad/s, for rates in deg/s and without rates; empty if the recording is too short."""
    return [size for unit in (1.0, DEGREE, 0.0) if (size := gravity_size(imu, unit)) is not None]


def _refuse_degrees(imu: ImuStream, what: str) -> None:
    fast = float(np.percentile(np.linalg.norm(imu.gyro, axis=1), 99))
    if fast > _FASTEST_RAD_S:
        raise RecordingError(
            f"{what}: the angular rate reaches {fast:.3g}, which is implausible in rad/s and looks like deg/s; "
            "set gyro_unit: deg/s in the rig file."
        )
