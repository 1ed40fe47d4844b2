"""Topics of a recording, types of messages, and the choice of the topic of each sensor."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np

from icalib.errors import RecordingError
from icalib.kinds import readers

# Topics of a recording, and the choice of the topic of each sensor.
#
# Each kind of sensor declares its data formats in its `read` module. `MESSAGES` lists ROS message types, `UNREAD`
# types that icalib cannot read, and `TABLES` files of a folder (`data.tables.files`). Several kinds may declare the
# same type.

_MAX_LISTED = 20


@dataclass(frozen=True)
class MessageType:
    """A ROS message type that a kind of sensor is read from.

    name: in ROS 2 notation. kind: the quantity that it contains, as `TopicInfo.kind`. stamped: the message has a
    header with a stamp. latched_suffix: ending of the names of topics whose messages are valid for the whole
    recording (latched); None: no topic. parsers: by encoding (ros1, cdr), function from bytes to message for types
    unknown to rosbags; it raises ValueError. read_as: name of the type in rosbags; empty: `name`. definition: its
    fields, one a line, if rosbags does not have them for both ROS 1 and ROS 2.
    """

    name: str
    kind: str
    stamped: bool = True
    latched_suffix: str | None = None
    parsers: Mapping[str, Callable[[bytes], Any]] = field(default_factory=dict)
    read_as: str = ""
    definition: str = ""


@dataclass(frozen=True)
class UnreadType:
    """Message types with the right quantity in a format that icalib cannot read.

    pattern: regular expression of type names. kind: the quantity, as `TopicInfo.kind`. words: for the error message,
    the content of the messages and the remedy.
    """

    pattern: str
    kind: str
    words: str


@cache
def message_types() -> dict[str, MessageType]:
    """All message types that kinds of sensors declare, by name."""
    return {t.name: t for reader in readers().values() for t in reader.messages}


def type_not_read(name: str) -> tuple[str, str] | None:
    """`kind` and `words` of the `UnreadType` that the message type `name` matches; None if there is none."""
    unread = (t for reader in readers().values() for t in reader.unread)
    return next(((t.kind, t.words) for t in unread if re.fullmatch(t.pattern, name, re.IGNORECASE)), None)


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a bag, or one table, image folder or video of a folder.

    name: value of `topic` (for tables: `path`) of a sensor in the rig file. type: message type, or kind of file. kind:
    the quantity, such as "image" or "pose", as kinds of sensors declare it; empty if icalib cannot read it. count:
    number of messages, rows or images. first_ns, last_ns: receive times of the first and last message of a bag, stamps
    in a folder; None without messages.
    """

    name: str
    type: str
    kind: str
    count: int
    first_ns: int | None
    last_ns: int | None


def choose_topic(where: str, topics: Sequence[TopicInfo], sensor: str, given: str | None, *kinds: str) -> TopicInfo:
    """The topic of a sensor, of one of `kinds`: `given`, else the only one whose name contains the name `sensor`, else
    the only one.

    where: the recording, for messages. Raises RecordingError listing the topics if none or several remain.
    """
    if given is not None:
        return _given(where, topics, given, kinds)
    usable = [t for t in topics if t.kind in kinds and t.count]
    named = [t for t in usable if sensor in (*t.name.split("/"), PurePosixPath(t.name).stem)]
    candidates = named or usable
    if len(candidates) == 1:
        return candidates[0]
    if not candidates:
        _refuse_unreadable(f"{where} has no {kinds[0]} for {sensor}", topics, kinds)
        raise RecordingError(
            f"{where} has no {kinds[0]} for {sensor}; {listing(topics)}; record it, or correct the rig file."
        )
    names = ", ".join(t.name for t in candidates)
    raise RecordingError(f"{where}: {sensor} may be any of {names}; set `topic` of {sensor} in the rig file.")


def find_topic(where: str, topics: Sequence[TopicInfo], name: str) -> TopicInfo:
    """The topic `name`, with or without leading slash. Raises RecordingError listing all topics if it is missing."""
    for topic in topics:
        if topic.name.lstrip("/") == name.lstrip("/"):
            return topic
    raise RecordingError(f"{where} has no topic {name}; {listing(topics)}; correct the topic.")


def listing(topics: Sequence[TopicInfo]) -> str:
    """The topics with their types, for an error message."""
    if not topics:
        return "it holds no topics"
    more = f" and {len(topics) - _MAX_LISTED} more" if len(topics) > _MAX_LISTED else ""
    return "it holds " + ", ".join(f"{t.name} ({t.type})" for t in topics[:_MAX_LISTED]) + more


def _refuse_unreadable(missing: str, topics: Sequence[TopicInfo], kinds: Sequence[str]) -> None:
    """Raises RecordingError if one of `topics` has one of `kinds` in a format that icalib cannot read. missing: start
    of the message."""
    for topic in topics:
        if (unread := type_not_read(topic.type)) and unread[0] in kinds:
            raise RecordingError(f"{missing}: {topic.name} ({topic.type}) holds {unread[1]}.")


def _given(where: str, topics: Sequence[TopicInfo], given: str, kinds: Sequence[str]) -> TopicInfo:
    topic = find_topic(where, topics, given)
    if topic.kind not in kinds:
        _refuse_unreadable(f"{where} has no {kinds[0]} in {given}", [topic], kinds)
        raise RecordingError(f"{where}: {given} is {topic.type}, not {kinds[0]}; {listing(topics)}; correct `topic`.")
    if not topic.count:
        raise RecordingError(f"{where}: {given} holds no messages; record again with that sensor running.")
    return topic


# Readers of ROS messages that several kinds of sensors use.
#
# Arrays of poses, odometry and twists from ROS messages, for several kinds of sensors.


class HasMessages(Protocol):
    """Interface to the messages of a bag; see `BagRecording`."""

    root: Path

    def messages(self, topic: str, kind: str, convert: Callable[[Any], Any] = ...) -> Iterator[tuple[int, Any]]: ...


@dataclass(frozen=True)
class PoseMessages:
    """Poses T_frame_body: stamps_ns (N,) int64, position (N, 3) m, rotation (N, 3, 3) R_frame_body. Rotations are NaN
    for messages without a unit quaternion."""

    frame: str
    stamps_ns: np.ndarray
    position: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class TwistStream:
    """Velocities in coordinates of `frame`: stamps_ns (N,) int64, linear (N, 3) m/s, angular (N, 3) rad/s."""

    frame: str
    stamps_ns: np.ndarray
    linear: np.ndarray
    angular: np.ndarray


def read_poses(bag: HasMessages, topic: str, kind: str = "pose") -> PoseMessages:
    """All PoseStamped, PoseWithCovarianceStamped, TransformStamped or (kind "odometry") Odometry of `topic`. Raises
    RecordingError as `BagRecording.messages`, and if a frame changes."""
    stamps_ns, messages = all_messages(bag, topic, kind)
    if messages and hasattr(messages[0], "child_frame_id"):
        _frame(bag, topic, messages, lambda m: m.child_frame_id)
    return _poses(bag, topic, _frame(bag, topic, messages), stamps_ns, [pose_of(m) for m in messages])


@dataclass(frozen=True)
class _Placed:
    """A transform with the field names of geometry_msgs/Pose."""

    position: Any
    orientation: Any


def pose_of(message: Any) -> Any:
    """The geometry_msgs/Pose of a message of one of these types."""
    if hasattr(message, "transform"):
        return _Placed(message.transform.translation, message.transform.rotation)
    return message.pose.pose if hasattr(message.pose, "pose") else message.pose


def poses_and_twists(bag: HasMessages, topic: str, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Unchecked poses (N, 7) x, y, z [m] and quaternion x, y, z, w, and twists (N, 6) [m/s, rad/s] of a topic of poses
    or odometry; twists are zero where messages have none. Raises RecordingError as `BagRecording.messages`."""
    _, messages = all_messages(bag, topic, kind)
    poses = [pose_of(m) for m in messages]
    twists = [m.twist.twist if hasattr(m, "twist") else None for m in messages]
    rows = [(*_xyz(p.position), *_xyz(p.orientation), p.orientation.w) for p in poses]
    speeds = [(*_xyz(t.linear), *_xyz(t.angular)) if t else (0.0,) * 6 for t in twists]
    return np.array(rows).reshape(-1, 7), np.array(speeds).reshape(-1, 6)


def read_twists(bag: HasMessages, topic: str, kind: str = "twist") -> TwistStream:
    """All TwistStamped, or velocities of all Odometry (kind "odometry"), of `topic`; poses are not checked. Raises
    RecordingError as `BagRecording.messages`, and for a frame that changes."""
    stamps_ns, messages = all_messages(bag, topic, kind)
    frame = _frame(bag, topic, messages, lambda m: getattr(m, "child_frame_id", m.header.frame_id))
    return _twists(frame, stamps_ns, [getattr(m.twist, "twist", m.twist) for m in messages])


def all_messages(bag: HasMessages, topic: str, kind: str) -> tuple[np.ndarray, list[Any]]:
    """(N,) int64 stamps [ns] and N messages of `topic`. Raises RecordingError as `BagRecording.messages`."""
    stamped = list(bag.messages(topic, kind))
    return np.array([stamp_ns for stamp_ns, _ in stamped], np.int64), [message for _, message in stamped]


def _frame(
    bag: HasMessages, topic: str, messages: list[Any], of: Callable[[Any], str] = lambda m: m.header.frame_id
) -> str:
    frames = list(dict.fromkeys(of(m) for m in messages))
    if len(frames) > 1:
        raise RecordingError(
            f"{bag.root} {topic} mixes the frames {', '.join(frames)}; record each under its own name."
        )
    return frames[0] if frames else ""


def _poses(bag: HasMessages, topic: str, frame: str, stamps_ns: np.ndarray, poses: list[Any]) -> PoseMessages:
    position = np.array([_xyz(p.position) for p in poses]).reshape(-1, 3)
    xyzw = np.array([(*_xyz(p.orientation), p.orientation.w) for p in poses]).reshape(-1, 4)
    good = np.abs(np.linalg.norm(xyzw, axis=1) - 1.0) < 1e-3
    if 2 * (~good).sum() > len(good):
        raise RecordingError(
            f"{bag.root} {topic}: the orientation at {stamps_ns[np.argmin(good)]} ns is not a unit quaternion, "
            "nor are most others; correct the publisher."
        )
    return PoseMessages(frame, stamps_ns, position, unit_rotations(xyzw, good))


def unit_rotations(xyzw: np.ndarray, good: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotation matrices of quaternions xyzw (N, 4), normalized first; NaN where `good` (N,) is False."""
    xyzw = np.where(good[:, None], xyzw, np.nan)
    return rotations(xyzw / np.linalg.norm(xyzw, axis=1)[:, None])


def rotations(xyzw: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotation matrices of unit quaternions xyzw (N, 4)."""
    x, y, z, w = xyzw.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _twists(frame: str, stamps_ns: np.ndarray, twists: list[Any]) -> TwistStream:
    linear = np.array([_xyz(t.linear) for t in twists]).reshape(-1, 3)
    angular = np.array([_xyz(t.angular) for t in twists]).reshape(-1, 3)
    return TwistStream(frame, stamps_ns, linear, angular)


def _xyz(v: Any) -> tuple[float, float, float]:
    return v.x, v.y, v.z
