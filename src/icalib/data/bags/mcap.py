"""MCAP files: https://mcap.dev/spec."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO, final

import numpy as np

from icalib.data.bags.storage import Connection, DamageError, Span, SpanStorage, Tally, full_type

MCAP_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX = 2, 3, 4, 5, 6, 7
_RECORD = struct.Struct("<BQ")  # kind, length
_MESSAGE_HEAD = struct.Struct("<HIqq")  # channel, sequence, log time, publish time
_CHUNK_HEAD = struct.Struct("<QQQI")  # first and last log time, uncompressed size, CRC-32
_INDEX_ENTRY = np.dtype([("log_time", "<i8"), ("offset", "<u8")])
_LONGEST_NAME = 16  # bytes of the name of a compression; a longer one is damage
_RUN_BYTES = 1 << 20  # messages outside of chunks are grouped into blocks of this size


@final
class McapStorage(SpanStorage):
    """An MCAP file, with or without chunks, index, summary and footer, of any profile."""

    def _scan(self, file: BinaryIO, size: int) -> None:
        """See `SpanStorage`. A truncated chunk is noted, too, as its first messages can be read."""
        self._schemas: dict[int, str] = {}
        self._run: Span | None = None  # current block of messages outside of chunks
        file.seek(len(MCAP_MAGIC))
        while (at := file.tell()) < size:
            try:
                kind, length = _RECORD.unpack(file.read(_RECORD.size))
                begin = file.tell()
                if begin + length > size and kind != _CHUNK:
                    raise DamageError
                if kind == _FOOTER:
                    return _refuse_cut_index(file)
                self._note_record(kind, file, at, min(length, size - begin))
            except (struct.error, UnicodeDecodeError, DamageError) as error:
                file.seek(at)
                raise DamageError from error
            if begin + length > size:
                file.seek(size)
                raise DamageError
            file.seek(begin + length)
        raise DamageError  # no footer: the file is truncated

    def _note_record(self, kind: int, file: BinaryIO, at: int, length: int) -> None:
        """Register the record that begins at byte `at`. `file` is positioned at its content of `length` bytes."""
        begin = file.tell()
        if kind == _CHUNK:
            _, _, _, crc = _CHUNK_HEAD.unpack(file.read(_CHUNK_HEAD.size))
            (letters,) = struct.unpack("<I", file.read(4))
            compression = file.read(min(letters, _LONGEST_NAME)).decode()
            (stored,) = struct.unpack("<Q", file.read(8))
            available = max(0, length - (file.tell() - begin))
            self.spans.append(Span(file.tell(), min(stored, available), compression, crc if stored <= available else 0))
        elif kind == _INDEX and self.spans:
            channel, size = struct.unpack("<HI", file.read(6))
            size = min(size, length - 6)
            entries = np.frombuffer(file.read(max(0, size - size % _INDEX_ENTRY.itemsize)), _INDEX_ENTRY)
            self.spans[-1].tally.setdefault(channel, Tally()).add_stamps(entries["log_time"])
        elif kind == _MESSAGE:
            channel, _, log_time, _ = _MESSAGE_HEAD.unpack(file.read(_MESSAGE_HEAD.size))
            self._grow_run(at, begin + length).count(channel, log_time)
        elif kind in (_SCHEMA, _CHANNEL):
            self._note_definition(kind, memoryview(file.read(length)))

    def _grow_run(self, at: int, end: int) -> Span:
        """The block of messages outside of chunks to which the record from byte `at` to `end` is added, current or
        new."""
        run = self._run
        if run is None or run.offset + run.size != at or run.size > _RUN_BYTES:
            self._run = run = Span(at, 0)
            self.spans.append(run)
        run.size = end - run.offset
        return run

    def _note_definition(self, kind: int, content: memoryview) -> None:
        if kind == _SCHEMA:
            (key,) = struct.unpack_from("<H", content)
            self._schemas[key] = full_type(_text(content, 2)[0])
        else:
            key, schema = struct.unpack_from("<HH", content)
            topic, end = _text(content, 4)
            encoding, _ = _text(content, end)
            self.connections[key] = Connection(topic, self._schemas.get(schema, "unknown"), encoding)

    def _walk(self, body: memoryview) -> Iterator[tuple[int, int, memoryview]]:
        at = 0
        try:
            while at < len(body):
                kind, length = _RECORD.unpack_from(body, at)
                begin = at + _RECORD.size
                at = begin + length
                if at > len(body):
                    raise DamageError
                if kind == _MESSAGE:
                    channel, _, log_time, _ = _MESSAGE_HEAD.unpack_from(body, begin)
                    yield channel, log_time, body[begin + _MESSAGE_HEAD.size : at]
                elif kind in (_SCHEMA, _CHANNEL):
                    self._note_definition(kind, body[begin:at])
        except (struct.error, UnicodeDecodeError) as error:
            raise DamageError from error


def _refuse_cut_index(file: BinaryIO) -> None:
    """Raises DamageError if the file does not end with the magic bytes. Then its index is truncated, but the index
    stands behind all messages, so none of them is lost."""
    file.seek(-len(MCAP_MAGIC), 2)
    if file.read() != MCAP_MAGIC:
        raise DamageError


def _text(content: memoryview, at: int) -> tuple[str, int]:
    """The text at byte `at`, and the position after it."""
    (n,) = struct.unpack_from("<I", content, at)
    return bytes(content[at + 4 : at + 4 + n]).decode(), at + 4 + n
