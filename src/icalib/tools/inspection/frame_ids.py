"""Frame ids of messages."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.data.recordings import BagRecording, Recording, TopicInfo
from icalib.errors import RecordingError


def frame_id(recording: Recording, topic: TopicInfo) -> str:
    """The frame id of the first message; empty in folders."""
    if not isinstance(recording, BagRecording):
        return ""
    first: Iterator = recording.messages(topic.name, topic.kind)
    try:
        _, message = next(first)
    except (RecordingError, StopIteration):
        return ""
    return str(message.header.frame_id)
