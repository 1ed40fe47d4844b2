"""Reads poses from tables, topics of poses or odometry, or chains of transforms, and checks them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from icalib.data.messages import read_poses
from icalib.data.recordings.base import Reading, ReadStream, Recording
from icalib.data.tables.table import TableFile, holds
from icalib.data.topics import MessageType, TopicInfo
from icalib.errors import RecordingError
from icalib.sensors.pose.read.checks import checked_poses
from icalib.sensors.pose.read.pose_tables import (
    POSE_TABLE,
    POSE_TABLES,
    PoseReadings,
    as_frame_sensor,
    is_tum_text,
    read_pose_file,
    stamps_by_row,
)
from icalib.sensors.pose.read.transforms import (
    DEFAULT_TOPIC,
    MESSAGE,
    MESSAGE_TYPE,
    TRANSFORMS,
    read_transform_poses,
    refuse_without_frames,
)
from icalib.sensors.pose.spec import PoseSensor
from icalib.sensors.sensor import TableLayout

_TRANSFORMS = MessageType(
    MESSAGE_TYPE, TRANSFORMS, stamped=False, latched_suffix="tf_static", read_as=MESSAGE_TYPE, definition=MESSAGE
)
MESSAGES = (
    MessageType("geometry_msgs/msg/PoseStamped", "pose"),
    MessageType("geometry_msgs/msg/PoseWithCovarianceStamped", "pose"),
    MessageType("geometry_msgs/msg/TransformStamped", "pose"),
    MessageType("nav_msgs/msg/Odometry", "odometry"),
    _TRANSFORMS,
    replace(_TRANSFORMS, name="tf/msg/tfMessage"),
)


def _stamps(path: Path, layout: TableLayout) -> np.ndarray:
    """(N,) int64 stamps [ns] of a table."""
    return read_pose_file(path.parent.name, path, layout).stamps_ns


def _is_one(path: Path) -> bool:
    """Whether a file named `poses.csv` contains poses, as tables of other sensors may have this name."""
    return is_tum_text(path) or any(holds(path, kind) for kind in POSE_TABLES)


def _is_tum(path: Path) -> bool:
    """Whether a text file of any other name is TUM text."""
    if path.stem == "poses":
        return False
    try:
        return holds(path, POSE_TABLE) and len(read_pose_file(path.stem, path).stamps_ns) > 1
    except RecordingError:
        return False


TABLES = (
    TableFile("poses.csv", "table of poses", "pose", _stamps, _is_one, POSE_TABLE, stamps_by_row),
    TableFile("poses.tum", "table of poses", "pose", _stamps, rows=stamps_by_row),
    TableFile("poses.txt", "table of poses", "pose", _stamps, rows=stamps_by_row),
    *(TableFile(f"*{ending}", "table of poses", "pose", _stamps, _is_tum) for ending in (".tum", ".txt")),
)


def read(recording: Recording, sensors: Sequence[PoseSensor], reading: Reading) -> list[ReadStream]:
    """The checked streams, with notes. Raises RecordingError as `readings` and `checked_poses` do."""
    streams = []
    for sensor in sensors:
        where = recording.where(sensor)
        written = reading.cut(readings(recording, sensor), f"{where} ({sensor.name})")
        streams.append(checked_poses(as_frame_sensor(written, sensor), sensor, where))
    return streams


def readings(recording: Recording, sensor: PoseSensor) -> PoseReadings:
    """All poses as recorded, from a chain of transforms, a table (which may be next to a bag), or a topic. Stamps may
    repeat or decrease.

    Raises RecordingError if the data are missing or cannot be read, naming file and line, or topic. It names the
    instant of an invalid rotation.
    """
    if sensor.frames is not None:
        if not recording.has_messages:
            raise RecordingError(
                f"{recording.root} is a folder, but `frames` of {sensor.name} needs the transforms (/tf) of a bag; "
                "give the bag, or remove `frames` from the rig file."
            )
        return read_transform_poses(recording, sensor, recording.note)
    topic = source(recording, sensor)
    if isinstance(topic, Path):
        poses = read_pose_file(sensor.name, topic, sensor.layout, recording.note, sensor.rotations)
        return recording.inside(poses, topic)
    poses = read_poses(recording, topic.name, topic.kind)
    order = recording.by_stamp(topic.name, poses.stamps_ns)
    return PoseReadings(sensor.name, poses.stamps_ns[order], poses.rotation[order], poses.position[order])


def source(recording: Recording, sensor: PoseSensor) -> Path | TopicInfo:
    """The table, which may be next to a bag, or the topic: of transforms if the sensor has `frames`, else of poses or
    odometry."""
    in_bag = sensor.topic is not None or sensor.frames is not None
    if not recording.has_messages or not (in_bag or recording.find(sensor.path) is None):
        return recording.table(sensor, sensor.path)
    if sensor.frames is not None:
        return recording.topic(sensor.name, sensor.topic or DEFAULT_TOPIC, TRANSFORMS)
    refuse_without_frames(recording.root, recording.topics(), sensor)
    return recording.topic(sensor.name, sensor.topic, "pose", "odometry")
