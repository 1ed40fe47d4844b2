"""Reads wheels, or velocities of a vehicle, from tables, joint states, odometry or twists into a checked stream."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from icalib.data.messages import read_twists
from icalib.data.recordings.base import Reading, ReadStream, Recording
from icalib.data.tables.table import TableFile, holds, read_table
from icalib.data.topics import MessageType, TopicInfo
from icalib.sensors.sensor import TableLayout
from icalib.sensors.wheels.read.checks import checked_wheels
from icalib.sensors.wheels.read.joints import read_joints
from icalib.sensors.wheels.read.raw_readings import (
    RELATIVE_POSES,
    STAMPS,
    UNITS,
    WheelReadings,
    read_wheel_joints,
    read_wheel_table,
    read_wheel_twists,
)
from icalib.sensors.wheels.spec import Wheels
from icalib.sensors.wheels.stream import WheelPoses

MESSAGES = (
    MessageType("sensor_msgs/msg/JointState", "joints"),
    MessageType("nav_msgs/msg/Odometry", "odometry"),
    MessageType("geometry_msgs/msg/TwistStamped", "twist"),
)


def _stamps(path: Path, layout: TableLayout) -> np.ndarray:
    del layout
    kind = RELATIVE_POSES if holds(path, RELATIVE_POSES) else STAMPS
    return read_table(path, kind).integers[:, 0].copy()


TABLES = tuple(TableFile(f"{m}.csv", f"table of {m}", "wheels", _stamps) for m in (*UNITS, "twist", "poses"))


def read(recording: Recording, sensors: Sequence[Wheels], reading: Reading) -> list[ReadStream]:
    """The checked stream of each set of wheels, with notes for the user. Raises RecordingError as `readings` and
    `checked_wheels`."""
    streams = []
    for sensor in sensors:
        where = recording.where(sensor)
        written = reading.cut(readings(recording, sensor), f"{where} ({sensor.name})")
        streams.append(checked_wheels(written, sensor, where))
    return streams


def readings(recording: Recording, sensor: Wheels) -> WheelReadings | WheelPoses:
    """All readings as recorded; stamps may still repeat or run backwards.

    Raises RecordingError naming file and line, or topic, where the data are missing or cannot be read.
    """
    topic, what = source(recording, sensor), f"{recording.where(sensor)} ({sensor.name})"
    if isinstance(topic, Path):
        return recording.inside(read_wheel_table(sensor, topic, recording.note), topic)
    if topic.kind in ("odometry", "twist"):
        read = read_wheel_twists(sensor, read_twists(recording, topic.name, topic.kind), what)
    else:
        read = read_wheel_joints(sensor, read_joints(recording, topic.name), what)
    order = recording.by_stamp(topic.name, read.stamps_ns)
    return WheelReadings(sensor.name, read.stamps_ns[order], read.value[order])


def source(recording: Recording, sensor: Wheels) -> Path | TopicInfo:
    """The table, or the topic of the readings: joint states, or twist or odometry if the wheels measure a twist."""
    if not recording.has_messages:
        return recording.table(sensor, sensor.path)
    kinds = ("twist", "odometry") if sensor.measures == "twist" else ("joints",)
    return recording.topic(sensor.name, sensor.topic, *kinds)
