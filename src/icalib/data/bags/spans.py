"""Bag files that are a row of blocks, each with its messages: what ROS 1 bags and MCAP files have in common."""

from __future__ import annotations

import bz2
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from icalib.base.extras import load_lz4, load_zstd
from icalib.base.file_hashes import hash_of
from icalib.base.unpacking import TooLargeError, unpacked
from icalib.data.bags.storage import Connection, Tally, cut_note
from icalib.errors import RecordingError


class _UnknownCompressionError(Exception):
    """A compression that the format does not have."""


class DamageError(Exception):
    """A record that is cut off or makes no sense."""


@dataclass
class Span:
    """A block: `size` bytes at `offset` of the file, which hold records; its messages by connection, once known."""

    offset: int
    size: int
    compression: str = ""
    crc: int = 0  # 0: none was written
    cut: bool = False  # the last of a file that was cut off, which has its own note
    tally: dict[int, Tally] = field(default_factory=dict)

    def count(self, connection: int, received_ns: int) -> None:
        self.tally.setdefault(connection, Tally()).add(1, received_ns, received_ns)


class SpanStorage(ABC):
    """A file of blocks. The trailing index is not needed: blocks are found one after the other, so a file that was
    cut off is read up to the cut by the same code."""

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
        """Find the blocks of a file of `size` bytes, and connections outside of them.

        Raises DamageError where the file ends early; it then stands there.
        """

    @abstractmethod
    def _walk(self, body: memoryview) -> Iterator[tuple[int, int, memoryview]]:
        """Messages of a block; notes its connections. Raises DamageError at a broken record."""

    def tally(self) -> dict[int, Tally]:
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
        """The records of a block; of a block that was cut off, as far as it can be decompressed."""
        file.seek(span.offset)
        stored = file.read(span.size)
        self._hash.saw(span.offset, stored, file)
        body = stored if span.compression in ("", "none") else _decompress(stored, span.compression)
        if span.crc and zlib.crc32(body) != span.crc:
            raise DamageError
        return memoryview(body)

    def _scan_to_the_end(self, file: BinaryIO, size: int) -> int | None:
        """Where the file is cut off, None if it is whole."""
        try:
            self._scan(file, size)
        except DamageError:
            if self.spans:
                self.spans[-1].cut = True
                self.spans[-1].tally = {}  # its index may be incomplete
            return file.tell()
        return None

    def _tally_by_walking(self, file: BinaryIO, span: Span) -> None:
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
