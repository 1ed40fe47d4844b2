"""Topics of a recording, and the choice of the topic of each sensor.

Each kind of sensor declares its data formats in its `read` module. `MESSAGES` lists ROS message types, `UNREAD` types
that icalib cannot read, and `TABLES` files of a folder (`data.tables.files`). Several kinds may declare the same type.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import PurePosixPath
from typing import Any

from icalib.errors import RecordingError
from icalib.sensors import SENSOR_KINDS, facet

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
    return {t.name: t for kind in SENSOR_KINDS for t in facet(kind, "read").MESSAGES}


def type_not_read(name: str) -> tuple[str, str] | None:
    """`kind` and `words` of the `UnreadType` that the message type `name` matches; None if there is none."""
    unread = (t for kind in SENSOR_KINDS for t in getattr(facet(kind, "read"), "UNREAD", ()))
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
