"""Interface of the readers of bag files, and common types.

Bag files that are sequences of blocks (chunks) of messages: common code for ROS 1 bags and MCAP files.
"""

from __future__ import annotations

import bz2
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np

from icalib.base.extras import load_lz4, load_zstd
from icalib.base.input_files import TooLargeError, hash_of, unpacked
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


class _UnknownCompressionError(Exception):
    """A compression that icalib does not support."""


class DamageError(Exception):
    """A truncated or invalid record."""


@dataclass
class Span:
    """A block of records: `size` bytes at `offset` of the file. tally: its messages by connection, once known."""

    offset: int
    size: int
    compression: str = ""
    crc: int = 0  # CRC-32 of the unpacked block; 0: not checked
    cut: bool = False  # last block of a truncated file, for which there is another note
    tally: dict[int, Tally] = field(default_factory=dict)

    def count(self, connection: int, received_ns: int) -> None:
        self.tally.setdefault(connection, Tally()).add(1, received_ns, received_ns)


class SpanStorage(ABC):
    """Reader of a file of blocks. It finds blocks sequentially, without the index at the end of the file. A truncated
    file is thus read by the same code, up to the truncation."""

    def __init__(self, path: Path, name: Path) -> None:
        self.path = path
        self.name = name
        self.connections: dict[int, Connection] = {}
        self.notes: list[str] = []
        self._hash = hash_of(path)
        self.spans: list[Span] = []
        with path.open("rb") as file:
            size = path.stat().st_size
            cut = self._scan_to_the_end(file, size)
            for span in self.spans:
                if not span.tally or not span.tally.keys() <= self.connections.keys():
                    self._tally_by_walking(file, span)
        if cut is not None:
            self.notes.append(cut_note(name, f"at byte {cut} of {size}", self.tally()))
        if self.notes and not self.tally():
            raise RecordingError(self.notes[0])

    @abstractmethod
    def _scan(self, file: BinaryIO, size: int) -> None:
        """Find the blocks of a file of `size` bytes, and connections outside of blocks.

        Raises DamageError if the file is truncated or damaged, with `file` positioned there.
        """

    @abstractmethod
    def _walk(self, body: memoryview) -> Iterator[tuple[int, int, memoryview]]:
        """Messages of an unpacked block: connection, receive time [ns], content. Registers connections of the block.

        Raises DamageError at an invalid record.
        """

    def tally(self) -> dict[int, Tally]:
        """By connection: number of messages in the file, and their first and last receive time."""
        total: dict[int, Tally] = {}
        for span in self.spans:
            for key, part in span.tally.items():
                total.setdefault(key, Tally()).add(part.count, part.first_ns, part.last_ns)
        return total

    def messages(self, wanted: Set[int]) -> Iterator[tuple[int, int, bytes]]:
        with self.path.open("rb") as file:
            for span in self.spans:
                if wanted & span.tally.keys():
                    for connection, received_ns, content in self._messages_of(file, span):
                        if connection in wanted:
                            yield connection, received_ns, bytes(content)

    def _messages_of(self, file: BinaryIO, span: Span) -> Iterator[tuple[int, int, memoryview]]:
        try:
            yield from self._walk(self._body(file, span))
        except _UnknownCompressionError as error:
            raise RecordingError(
                f"{self.name} is compressed by {str(error)!r}, which icalib cannot read; use zstd, lz4 or none."
            ) from None
        except (DamageError, TooLargeError) as error:
            large = isinstance(error, TooLargeError)
            what = f"is ignored: {error}." if large else "is damaged; the messages after the damage were ignored."
            note = f"{self.name}: the block at byte {span.offset} {what}"
            if not span.cut and note not in self.notes:
                self.notes.append(note)

    def _body(self, file: BinaryIO, span: Span) -> memoryview:
        """Unpacked records of a block; of a truncated block, as far as it can be unpacked. Raises DamageError."""
        file.seek(span.offset)
        stored = file.read(span.size)
        self._hash.saw(span.offset, stored, file)
        body = stored if span.compression in ("", "none") else _decompress(stored, span.compression)
        if span.crc and zlib.crc32(body) != span.crc:
            raise DamageError
        return memoryview(body)

    def _scan_to_the_end(self, file: BinaryIO, size: int) -> int | None:
        """Byte at which the file is truncated; None if it is complete. Finds all blocks before it."""
        try:
            self._scan(file, size)
        except DamageError:
            if self.spans:
                self.spans[-1].cut = True
                self.spans[-1].tally = {}  # its index may be incomplete
            return file.tell()
        return None

    def _tally_by_walking(self, file: BinaryIO, span: Span) -> None:
        """Counts the messages of a block without a usable index, by reading all of it."""
        span.tally = {}
        for connection, received_ns, _ in self._messages_of(file, span):
            span.count(connection, received_ns)


def _decompress(stored: bytes, compression: str) -> bytes:
    decompressor, errors = _decompressor(compression)
    try:
        return unpacked(decompressor, stored)
    except TooLargeError:
        raise
    except errors as error:
        raise DamageError from error


def _decompressor(compression: str) -> tuple[Any, tuple[type[Exception], ...]]:
    if compression == "bz2":
        return bz2.BZ2Decompressor(), (OSError, ValueError)
    if compression == "lz4":
        return load_lz4().LZ4FrameDecompressor(), (RuntimeError, ValueError, EOFError)
    if compression == "zstd":
        zstd = load_zstd()
        return zstd.ZstdDecompressor(), (zstd.ZstdError, ValueError, EOFError)
    raise _UnknownCompressionError(compression)
