"""Reads an IMU from tables or topics into a checked `ImuStream`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from icalib.data.recordings.base import Cut, Reading, ReadStream, Recording
from icalib.data.stamps.jumps import ClockJumps
from icalib.data.tables.columns import TableKind
from icalib.data.tables.table import TableFile, holds, read_table
from icalib.data.topics import MessageType
from icalib.sensors.imu.read.checks import checked_imu
from icalib.sensors.imu.read.halves import ImuHalf, ImuHalves, both, imu_source, one_stream, values_of
from icalib.sensors.imu.read.table_kinds import ACCEL_TABLE, GYRO_TABLE, IMU, IMU_ACCEL, IMU_GYRO, WHOLE, half_layouts
from icalib.sensors.imu.spec import ImuSensor, TwoSources
from icalib.sensors.imu.stream import ImuStream
from icalib.sensors.sensor import TableLayout

MESSAGES = (MessageType("sensor_msgs/msg/Imu", "imu"),)


def _stamps(kind: TableKind, half: int | None, path: Path, layout: TableLayout) -> np.ndarray:
    """(N,) int64 stamps [ns] of a table; half: 0 and 1, of the gyroscope and of the accelerometer alone."""
    return read_table(path, kind, layout if half is None else half_layouts(layout)[half]).integers[:, 0].copy()


TABLES = (
    TableFile("data.csv", WHOLE, "imu", partial(_stamps, IMU, None), partial(holds, kind=IMU), IMU),
    TableFile("*[Gg][Yy][Rr]*.csv", GYRO_TABLE, "imu", partial(_stamps, IMU_GYRO, 0), partial(holds, kind=IMU_GYRO)),
    TableFile("*[Aa][Cc][Cc]*.csv", ACCEL_TABLE, "imu", partial(_stamps, IMU_ACCEL, 1), partial(holds, kind=IMU_ACCEL)),
)


def read(recording: Recording, sensors: Sequence[ImuSensor], reading: Reading) -> list[ReadStream]:
    """The checked stream of each IMU, with notes for the user. Raises RecordingError as `read_imu`."""
    return [read_imu(recording, sensor, reading.cut) for sensor in sensors]


def read_imu(recording: Recording, sensor: ImuSensor, cut: Cut) -> tuple[ImuStream, tuple[str, ...]]:
    """Valid readings of one IMU in SI units within the time range that `cut` keeps, and notes for the user. Raises
    RecordingError as `readings`, `one_stream` and `checked_imu`."""
    where = recording.where(sensor)
    what = f"{where} ({sensor.name})"
    imu, joined = one_stream(readings(recording, sensor), what)
    imu, notes = checked_imu(cut(imu, what), where, sensor)
    return imu, joined + notes


def time_series(recording: Recording, sensor: ImuSensor) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Stamps (N,) int64 [ns] and readings (N, 3) as they are shown: gyro [deg/s] and accel [m/s^2]. Raises
    RecordingError as `read_imu`."""
    imu, _ = read_imu(recording, sensor, ClockJumps().cut)
    return imu.stamps_ns, {"gyro": np.rad2deg(imu.gyro), "accel": imu.accel}


def readings(recording: Recording, sensor: ImuSensor) -> ImuStream | ImuHalves:
    """All readings as recorded, in the recorded units; stamps may still repeat or run backwards. `ImuHalves` if
    gyroscope and accelerometer have separate topics or tables.

    Raises RecordingError naming file and line, or topic, where the data are missing or cannot be read.
    """
    return _from_messages(recording, sensor) if recording.has_messages else _from_tables(recording, sensor)


def _from_messages(recording: Recording, sensor: ImuSensor) -> ImuStream | ImuHalves:
    def rows(topic: str) -> tuple[np.ndarray, np.ndarray]:
        """Stamps (N,) [ns] and gyroscope and accelerometer readings (N, 6) of a topic, sorted by stamp."""
        stamped = [(stamp, values_of(message)) for stamp, message in recording.messages(topic, "imu")]
        stamps_ns = np.array([stamp for stamp, _ in stamped], np.int64)
        values = np.array([row for _, row in stamped], np.float64).reshape(-1, 6)
        order = recording.by_stamp(topic, stamps_ns)
        return stamps_ns[order], values[order]

    topic = imu_source(str(recording.root), recording, recording.topics(), sensor)
    if isinstance(topic, TwoSources):
        (gyro_ns, gyro), (accel_ns, accel) = rows(topic.gyro), rows(topic.accel)
        return ImuHalves(sensor.name, gyro_ns, gyro[:, :3].copy(), accel_ns, accel[:, 3:].copy())
    stamps_ns, values = rows(topic)
    return ImuStream(sensor.name, stamps_ns, values[:, :3].copy(), values[:, 3:].copy())


def _from_tables(recording: Recording, sensor: ImuSensor) -> ImuStream | ImuHalves:
    if isinstance(sensor.path, TwoSources):
        kinds, layouts, halves = (IMU_GYRO, IMU_ACCEL), half_layouts(sensor.layout), []
        for name, kind, layout in zip(both(sensor.path), kinds, layouts, strict=True):
            path = recording.table(sensor, name)
            table = read_table(path, kind, layout, recording.note)
            half = ImuHalf(sensor.name, table.integers[:, 0].copy(), table.decimals)
            halves.append(recording.inside(half, path))
        gyro, accel = halves
        return ImuHalves(sensor.name, gyro.stamps_ns, gyro.values, accel.stamps_ns, accel.values)
    path = recording.table(sensor, sensor.path)
    table = read_table(path, IMU, sensor.layout, recording.note)
    stamps_ns, values = table.integers[:, 0].copy(), table.decimals
    return recording.inside(ImuStream(sensor.name, stamps_ns, values[:, :3].copy(), values[:, 3:].copy()), path)


def source(recording: Recording, sensor: ImuSensor) -> str:
    """Topics or table files of the IMU, as text for messages."""
    if recording.has_messages:
        topic = imu_source(str(recording.root), recording, recording.topics(), sensor)
        return recording.place(" and ".join(both(topic)) if isinstance(topic, TwoSources) else topic)
    names = both(sensor.path) if isinstance(sensor.path, TwoSources) else (sensor.path,)
    return " and ".join(str(recording.table(sensor, name)) for name in names)
