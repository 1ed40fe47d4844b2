"""Reads tables, solutions of RTKLIB and messages into checked streams of positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from icalib.data.recordings.base import Reading, ReadStream, Recording
from icalib.data.tables.files import TableFile
from icalib.data.topics import MessageType, TopicInfo
from icalib.geometry.geodesy import east_north_up, latitude_longitude
from icalib.sensors.position.read.checks import checked_positions
from icalib.sensors.position.read.messages import from_navsat, from_positions
from icalib.sensors.position.read.readings import (
    AS_RECORDED,
    LocalFrame,
    PositionReadings,
    about_first,
    from_geodetic,
    good_fixes,
    left_out,
)
from icalib.sensors.position.read.rtklib import SUFFIX, read_pos
from icalib.sensors.position.read.tables import read_position_table
from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.sensor import TableLayout

NAVSAT, POINT = "navsat", "point"
POSITION_KINDS = (NAVSAT, POINT)  # kinds of topics with positions alone
POSE_KINDS = ("pose", "odometry")  # kinds of topics with poses
MESSAGES = (
    MessageType("sensor_msgs/msg/NavSatFix", NAVSAT),
    MessageType("geometry_msgs/msg/PointStamped", POINT),
)
Noted = tuple[PositionReadings, tuple[str, ...]]


def _stamps(path: Path, layout: TableLayout) -> np.ndarray:
    if _is_solution(path):
        return read_pos(path).stamps_ns
    return read_position_table(PositionSensor(path.parent.name, str(path), layout=layout), path)[0].stamps_ns


TABLES = (
    TableFile("positions.csv", "table of positions", "position", _stamps),
    TableFile(f"*{SUFFIX}", "solution of RTKLIB", "position", _stamps),
)


def read(recording: Recording, sensors: Sequence[PositionSensor], reading: Reading) -> list[ReadStream]:
    """The checked streams, and notes. Raises RecordingError where data are missing, cannot be read or cannot be
    right."""
    places = {sensor.name: f"{recording.where(sensor)} ({sensor.name})" for sensor in sensors}
    written = {sensor.name: _readings(recording, sensor, places[sensor.name]) for sensor in sensors}
    streams = []
    for sensor in sensors:
        what, (readings, notes) = places[sensor.name], written[sensor.name]
        if sensor.shared_frame:
            owner = written.get(sensor.shared_frame)
            frame = AS_RECORDED if owner is None else owner[0].frame
            if readings.frame is not frame:
                readings = readings.inside(what, frame, sensor.shared_frame)
                notes += (f"{what}: its positions were then converted to the frame of {sensor.shared_frame}.",)
        stream, more = checked_positions(reading.cut(readings, what), what)
        streams.append((stream, notes + more))
    return streams


def where(recording: Recording, sensor: PositionSensor) -> str:
    """Path of the table, or place of the topic, with the sensor's positions, for messages."""
    if _is_table(recording, sensor):
        return str(recording.table(sensor, sensor.path))
    return recording.place(_topic(recording, sensor).name)


def _is_table(recording: Recording, sensor: PositionSensor) -> bool:
    return not recording.has_messages or (sensor.topic is None and recording.find(sensor.path) is not None)


def _is_solution(path: Path) -> bool:
    return path.name.removesuffix(".gz").endswith(SUFFIX)


def _topic(recording: Recording, sensor: PositionSensor) -> TopicInfo:
    """The topic of a sensor. Messages with positions alone go before poses and odometry."""
    has_positions = any(t.kind in POSITION_KINDS and t.count for t in recording.topics())
    kinds = POSITION_KINDS if has_positions and sensor.topic is None else (*POSITION_KINDS, *POSE_KINDS)
    return recording.topic(sensor.name, sensor.topic, *kinds)


def _readings(recording: Recording, sensor: PositionSensor, what: str) -> Noted:
    """Readings in metres, and notes; what: names the source in messages."""
    if not _is_table(recording, sensor):
        return _of_topic(recording, sensor, _topic(recording, sensor), what)
    path = recording.table(sensor, sensor.path)
    if _is_solution(path):
        return _of_solution(recording, sensor, path, what)
    written, geodetic = read_position_table(sensor, path, recording.note)
    written = recording.inside(written, path)
    if not geodetic:
        return about_first(what, written)
    return from_geodetic(what, written, written.position, np.ones(len(written.stamps_ns), dtype=bool))


def _of_topic(recording: Recording, sensor: PositionSensor, topic: TopicInfo, what: str) -> Noted:
    messages = list(recording.messages(topic.name, topic.kind))
    order = recording.by_stamp(topic.name, np.array([stamp for stamp, _ in messages], np.int64))
    messages = [messages[k] for k in order.tolist()]
    if topic.kind != NAVSAT:
        return about_first(what, from_positions(sensor.name, messages))
    written, degrees = from_navsat(sensor.name, messages)
    good = good_fixes(written.status, sensor.least_status, len(degrees))
    readings, notes = from_geodetic(what, written, degrees, good)
    return readings, left_out(what, written.status, good, sensor.least_status) + notes


def _of_solution(recording: Recording, sensor: PositionSensor, path: Path, what: str) -> Noted:
    file = read_pos(path)
    written = PositionReadings(sensor.name, file.stamps_ns, file.values, file.covariance, file.status)
    written = recording.inside(written, path)
    good = good_fixes(written.status, sensor.least_status, len(written.stamps_ns))
    notes = left_out(what, written.status, good, sensor.least_status)
    if file.kind == "geodetic":
        readings, more = from_geodetic(what, written, written.position, good)
        return readings, notes + more
    written = written.some(good)
    if file.kind == "earth" and len(written.stamps_ns):
        written = _levelled(written)
    readings, more = about_first(what, written)
    return readings, notes + more


def _levelled(written: PositionReadings) -> PositionReadings:
    """Earth-centred positions, converted to metres east, north and up of the first one."""
    R = east_north_up(*latitude_longitude(written.position[0]))
    covariance = R @ written.covariance @ R.T if len(written.covariance) else written.covariance
    frame = LocalFrame(written.position[0], R, True)
    return replace(written, position=(written.position - frame.origin) @ R.T, covariance=covariance, frame=frame)
