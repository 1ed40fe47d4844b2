"""Interface of the readers of bag files, and common types."""

from __future__ import annotations

from collections.abc import Iterator, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from icalib.errors import RecordingError


@dataclass(frozen=True)
class Connection:
    """A topic of a bag file. type: such as sensor_msgs/msg/Image. encoding: serialization of messages, ros1 or cdr."""

    topic: str
    type: str
    encoding: str


@dataclass
class Tally:
    """Number of messages, and receive times [ns] of the first and last one."""

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
    """Reader of one bag file. Opening raises RecordingError if nothing can be read. notes: sentences on damage."""

    name: Path  # for messages; the file that is read may be an unpacked copy
    connections: dict[int, Connection]
    notes: list[str]

    def tally(self) -> dict[int, Tally]:
        """Number and receive times of messages by connection id."""
        ...

    def messages(self, wanted: Set[int]) -> Iterator[tuple[int, int, bytes]]:
        """Messages of the connections `wanted` in the order of the file: connection id, receive time [ns], bytes.

        Memory does not grow with the length of the file.
        """
        ...


def full_type(name: str) -> str:
    """Name of a message type in ROS 2 notation: sensor_msgs/Image -> sensor_msgs/msg/Image."""
    package, _, message = name.partition("/")
    return name if "/" in message or not message else f"{package}/msg/{message}"


def cut_note(name: Path, where: str, tally: dict[int, Tally]) -> str:
    """Note on a file that can be read only before the position `where`. Raises RecordingError if `tally` is empty."""
    count = sum(t.count for t in tally.values())
    if not count:
        raise RecordingError(
            f"{name} is truncated or damaged {where}, before its first message; copy or record it again."
        )
    span = max(t.last_ns for t in tally.values()) - min(t.first_ns for t in tally.values())
    return f"{name} is truncated or damaged {where}; the readable part is used: {count} messages, {span * 1e-9:.1f} s."
