"""ROS 1 bags, format 2.0: https://wiki.ros.org/Bags/Format/2.0."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO, final

import numpy as np

from icalib.data.bags.storage import Connection, DamageError, Span, SpanStorage, Tally, full_type
from icalib.errors import RecordingError

ROS1_MAGIC = b"#ROSBAG V"
_VERSION = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_LARGEST_HEADER = 1 << 20  # bytes; headers have some hundred, a larger one is damage
_INDEX_ENTRY = np.dtype([("secs", "<u4"), ("nsecs", "<u4"), ("offset", "<u4")])

Fields = dict[bytes, bytes]


@final
class Ros1Storage(SpanStorage):
    """Reader of a ROS 1 bag."""

    def _scan(self, file: BinaryIO, size: int) -> None:
        if file.read(len(_VERSION)) != _VERSION:
            raise RecordingError(f"{self.name} is a bag older than format 2.0; convert it with `rosbag fix`.")
        index_at = 0
        while (at := file.tell()) < size:
            try:
                fields, length = _read_header(file)
                kind = _kind(fields)
                if kind == _BAG_HEADER:
                    self._refuse_encrypted(fields)
                    index_at = _number("<Q", fields, b"index_pos")
                self._note_record(kind, fields, file, min(length, size - file.tell()))
                complete = file.tell() + length <= size
            except (struct.error, KeyError, UnicodeDecodeError) as error:
                file.seek(at)
                raise DamageError from error
            if not complete:
                file.seek(size)
                raise DamageError
            file.seek(length, 1)
        if not 0 < index_at <= size:  # position of the index, which the recorder writes last
            raise DamageError

    def _note_record(self, kind: int, fields: Fields, file: BinaryIO, length: int) -> None:
        """Register a record. `file` is positioned at its content of `length` bytes, before and after the call."""
        at = file.tell()
        if kind == _CHUNK:
            self.spans.append(Span(at, length, fields[b"compression"].decode()))
        elif kind == _INDEX and self.spans:
            entries = np.frombuffer(file.read(length - length % _INDEX_ENTRY.itemsize), _INDEX_ENTRY)
            received_ns = entries["secs"].astype(np.int64) * 1_000_000_000 + entries["nsecs"]
            self.spans[-1].tally.setdefault(_number("<I", fields, b"conn"), Tally()).add_stamps(received_ns)
        elif kind == _CONNECTION:
            self._note_connection(fields, file.read(length))
        file.seek(at)

    def _note_connection(self, fields: Fields, content: bytes) -> None:
        described = _fields(content)
        topic = "/" + b"/".join(p for p in fields[b"topic"].split(b"/") if p).decode()
        self.connections[_number("<I", fields, b"conn")] = Connection(
            topic, full_type(described[b"type"].decode()), "ros1"
        )

    def _refuse_encrypted(self, fields: Fields) -> None:
        if fields.get(b"encryptor"):
            raise RecordingError(f"{self.name} is encrypted; decrypt it with `rosbag decrypt`.")

    def _walk(self, body: memoryview) -> Iterator[tuple[int, int, memoryview]]:
        at = 0
        try:
            while at < len(body):
                n = struct.unpack_from("<I", body, at)[0]
                fields = _fields(bytes(body[at + 4 : at + 4 + n]))
                begin = at + 8 + n
                at = begin + struct.unpack_from("<I", body, begin - 4)[0]
                kind = _kind(fields)
                if at > len(body):
                    raise DamageError
                if kind == _CONNECTION:
                    self._note_connection(fields, bytes(body[begin:at]))
                elif kind == _MESSAGE:
                    secs, nsecs = struct.unpack("<II", fields[b"time"])
                    yield _number("<I", fields, b"conn"), secs * 1_000_000_000 + nsecs, body[begin:at]
        except (struct.error, KeyError, UnicodeDecodeError) as error:
            raise DamageError from error


def _read_header(file: BinaryIO) -> tuple[Fields, int]:
    """Header fields of the next record, and the length of its content; leaves `file` positioned at the content."""
    (n,) = struct.unpack("<I", file.read(4))
    if n > _LARGEST_HEADER:
        raise struct.error
    fields = _fields(file.read(n))
    (length,) = struct.unpack("<I", file.read(4))
    return fields, length


def _fields(header: bytes) -> Fields:
    fields: Fields = {}
    at = 0
    while at < len(header):
        (n,) = struct.unpack_from("<I", header, at)
        name, equals, value = header[at + 4 : at + 4 + n].partition(b"=")
        if not equals or at + 4 + n > len(header):
            raise struct.error
        fields[name] = value
        at += 4 + n
    return fields


def _kind(fields: Fields) -> int:
    kind = _number("<B", fields, b"op")
    if not _MESSAGE <= kind <= _CONNECTION:
        raise struct.error
    return kind


def _number(form: str, fields: Fields, name: bytes) -> int:
    return struct.unpack(form, fields[name])[0]
