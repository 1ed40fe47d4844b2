"""What the reader of a bag file must do, and what all of them share."""

from __future__ import annotations

from collections.abc import Iterator, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from icalib.errors import RecordingError


@dataclass(frozen=True)
class Connection:
    """One source of messages in a bag file; `type` as in sensor_msgs/msg/Image, `encoding` of its bytes: ros1, cdr."""

    topic: str
    type: str
    encoding: str


@dataclass
class Tally:
    """How many messages, and when the first and the last of them were received [ns]."""

    count: int = 0
    first_ns: int = 2**63 - 1
    last_ns: int = -(2**63)

    def add(self, count: int, first_ns: int, last_ns: int) -> None:
        self.count += count
        self.first_ns = min(self.first_ns, first_ns)
        self.last_ns = max(self.last_ns, last_ns)

    def add_stamps(self, received_ns: np.ndarray) -> None:
        if len(received_ns):
            self.add(len(received_ns), int(received_ns.min()), int(received_ns.max()))


class Storage(Protocol):
    """One bag file. Opening it raises RecordingError where nothing can be read; what is damaged stands in `notes`."""

    name: Path  # for sentences; what is read may be a decompressed copy
    connections: dict[int, Connection]
    notes: list[str]

    def tally(self) -> dict[int, Tally]:
        """Messages by connection, without reading them all."""
        ...

    def messages(self, wanted: Set[int]) -> Iterator[tuple[int, int, bytes]]:
        """Messages of the connections `wanted`: connection, when it was received [ns], bytes; in the order of the file.

        Memory is bounded whatever the length of the file.
        """
        ...


def full_type(name: str) -> str:
    """The name of a type as ROS 2 writes it: sensor_msgs/Image -> sensor_msgs/msg/Image."""
    package, _, message = name.partition("/")
    return name if "/" in message or not message else f"{package}/msg/{message}"


def cut_note(name: Path, where: str, tally: dict[int, Tally]) -> str:
    """The sentence for a file of which only the part before `where` can be read; RecordingError if that is nothing."""
    count = sum(t.count for t in tally.values())
    if not count:
        raise RecordingError(
            f"{name} is truncated or damaged {where}, before its first message; copy or record it again."
        )
    span = max(t.last_ns for t in tally.values()) - min(t.first_ns for t in tally.values())
    return f"{name} is truncated or damaged {where}; the readable part is used: {count} messages, {span * 1e-9:.1f} s."
