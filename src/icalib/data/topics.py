"""What a recording holds, and which part of it is a sensor's.

Each kind of sensor declares in its `read` module what it is read from: `MESSAGES` and `UNREAD` are types of messages,
`TABLES` files of a folder (`data.tables.files`). Several kinds may declare the same type.
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
    """A type of messages that a kind of sensor is read from.

    name: as ROS 2 writes it; kind: a word for what they hold, `TopicInfo.kind`. stamped: each has one stamp, in its
    header. lasting: what the names of topics end with whose messages hold for the whole recording; None: of no topic.
    parsers: by encoding (ros1, cdr), from the bytes of a message, where rosbags does not know the type; they raise
    ValueError. read_as: the name by which rosbags knows it; ros1: its definition, where rosbags has it for ROS 2 only.
    """

    name: str
    kind: str
    stamped: bool = True
    lasting: str | None = None
    parsers: Mapping[str, Callable[[bytes], Any]] = field(default_factory=dict)
    read_as: str = ""
    ros1: str = ""


@dataclass(frozen=True)
class UnreadType:
    """Types of messages that hold what a sensor needs in a form that icalib does not read.

    pattern: a regular expression of their names; kind: what they would have to be; words: what they hold, and what to
    do about it.
    """

    pattern: str
    kind: str
    words: str


@cache
def message_types() -> dict[str, MessageType]:
    """All that some kind of sensor declares, by name."""
    return {t.name: t for kind in SENSOR_KINDS for t in facet(kind, "read").MESSAGES}


def type_not_read(name: str) -> tuple[str, str] | None:
    """`UnreadType.kind` and its words, where a type of messages is declared as such; else None."""
    unread = (t for kind in SENSOR_KINDS for t in getattr(facet(kind, "read"), "UNREAD", ()))
    return next(((t.kind, t.words) for t in unread if re.fullmatch(t.pattern, name, re.IGNORECASE)), None)


@dataclass(frozen=True)
class TopicInfo:
    """One stream of a recording.

    name: what `topic` (of a folder's tables: `path`) of a sensor in the rig file may be. type: of its messages, or what
    it is in a folder. kind: a word for what it holds, as the kinds of sensors declare it; empty for what icalib does
    not read. first_ns, last_ns: when the first and last message were
    received in a bag, the first and last stamp in a folder; None where there are no messages.
    """

    name: str
    type: str
    kind: str
    count: int
    first_ns: int | None
    last_ns: int | None


def choose_topic(where: str, topics: Sequence[TopicInfo], sensor: str, given: str | None, *kinds: str) -> TopicInfo:
    """The topic of one of `kinds` that is `sensor`'s: the one `given`, else the only one with the sensor's name in its
    own, else the only one.

    Raises RecordingError naming the recording (`where`) and listing what there is.
    """
    if given is not None:
        return _given(where, topics, given, kinds)
    found = [t for t in topics if t.kind in kinds and t.count]
    named = [t for t in found if sensor in (*t.name.split("/"), PurePosixPath(t.name).stem)]
    candidates = named or found
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
    """The topic `name`, with or without its leading slash. Raises RecordingError listing the topics that there are."""
    for topic in topics:
        if topic.name.lstrip("/") == name.lstrip("/"):
            return topic
    raise RecordingError(f"{where} has no topic {name}; {listing(topics)}; correct the topic.")


def listing(topics: Sequence[TopicInfo]) -> str:
    """The topics with their types, for a sentence."""
    if not topics:
        return "it holds no topics"
    more = f" and {len(topics) - _MAX_LISTED} more" if len(topics) > _MAX_LISTED else ""
    return "it holds " + ", ".join(f"{t.name} ({t.type})" for t in topics[:_MAX_LISTED]) + more


def _refuse_unreadable(missing: str, topics: Sequence[TopicInfo], kinds: Sequence[str]) -> None:
    """Raises RecordingError where one of `topics` holds what is `missing` in a form that is not read."""
    for topic in topics:
        if (held := type_not_read(topic.type)) and held[0] in kinds:
            raise RecordingError(f"{missing}: {topic.name} ({topic.type}) holds {held[1]}.")


def _given(where: str, topics: Sequence[TopicInfo], given: str, kinds: Sequence[str]) -> TopicInfo:
    topic = find_topic(where, topics, given)
    if topic.kind not in kinds:
        _refuse_unreadable(f"{where} has no {kinds[0]} in {given}", [topic], kinds)
        raise RecordingError(f"{where}: {given} is {topic.type}, not {kinds[0]}; {listing(topics)}; correct `topic`.")
    if not topic.count:
        raise RecordingError(f"{where}: {given} holds no messages; record again with that sensor running.")
    return topic
