"""Readers of bag files of ROS 1 and ROS 2: serialized messages in the order in which they were written."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import zlib
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Set
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Protocol, final

import numpy as np

from icalib.base.extras import load_lz4, load_zstd
from icalib.base.files import TooLargeError, hash_of, unpacked
from icalib.base.remark import Remark
from icalib.errors import RecordingError

# Interface of the readers of bag files, and common types.
#
# Bag files that are sequences of blocks (chunks) of messages: common code for ROS 1 bags and MCAP files.


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
    notes: list[Remark]

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


def cut_note(name: Path, where: str, tally: dict[int, Tally]) -> Remark:
    """Note on a file that can be read only before the position `where`. Raises RecordingError if `tally` is empty."""
    count = sum(t.count for t in tally.values())
    if not count:
        raise RecordingError(
            f"{name} is truncated or damaged {where}, before its first message; copy or record it again."
        )
    span = max(t.last_ns for t in tally.values()) - min(t.first_ns for t in tally.values())
    return Remark(
        "bag_truncated",
        f"{name} is truncated or damaged {where}; the readable part is used: {count} messages, {span * 1e-9:.1f} s.",
    )


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
    file is thus read by the same code, up to the truncation. growing: the file is being written; only `grown` reads."""

    def __init__(self, path: Path, name: Path, growing: bool = False) -> None:
        self.path = path
        self.name = name
        self.connections: dict[int, Connection] = {}
        self.notes: list[Remark] = []
        self.growing = growing
        self._hash = None if growing else hash_of(path)
        self._scanned = 0  # bytes up to the end of the last complete record
        self.spans: list[Span] = []
        if growing:
            return
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

    def grown(self) -> Iterator[tuple[int, int, bytes]]:
        """Messages as by `messages`, of all connections, in blocks that were completed since the last call."""
        with self.path.open("rb") as file:
            self.spans = []
            with suppress(DamageError):  # the end of what is written so far
                self._scan(file, self.path.stat().st_size)
            for span in self.spans:
                if span.offset + span.size <= self._scanned:
                    for connection, received_ns, content in self._messages_of(file, span):
                        yield connection, received_ns, bytes(content)

    @abstractmethod
    def _scan(self, file: BinaryIO, size: int) -> None:
        """Find the blocks of a file of `size` bytes after byte `_scanned`, and connections outside of blocks.

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
            note = Remark("bag_block_damaged", f"{self.name}: the block at byte {span.offset} {what}")
            if not span.cut and note not in self.notes:
                self.notes.append(note)

    def _body(self, file: BinaryIO, span: Span) -> memoryview:
        """Unpacked records of a block; of a truncated block, as far as it can be unpacked. Raises DamageError."""
        file.seek(span.offset)
        stored = file.read(span.size)
        if self._hash is not None:
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


# MCAP files: https://mcap.dev/spec.

MCAP_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK, _MCAP_INDEX = 2, 3, 4, 5, 6, 7
_RECORD = struct.Struct("<BQ")  # kind, length
_MESSAGE_HEAD = struct.Struct("<HIqq")  # channel, sequence, log time, publish time
_CHUNK_HEAD = struct.Struct("<QQQI")  # first and last log time, uncompressed size, CRC-32
_MCAP_INDEX_ENTRY = np.dtype([("log_time", "<i8"), ("offset", "<u8")])
_LONGEST_NAME = 16  # bytes of the name of a compression; a longer one is damage
_RUN_BYTES = 1 << 20  # messages outside of chunks are grouped into blocks of this size


@final
class McapStorage(SpanStorage):
    """An MCAP file, with or without chunks, index, summary and footer, of any profile."""

    def _scan(self, file: BinaryIO, size: int) -> None:
        """See `SpanStorage`. A truncated chunk is noted, too, as its first messages can be read."""
        if not self._scanned:
            self._schemas: dict[int, str] = {}
            self._scanned = len(MCAP_MAGIC)
        self._run: Span | None = None  # current block of messages outside of chunks
        file.seek(self._scanned)
        while (at := file.tell()) < size:
            try:
                kind, length = _RECORD.unpack(file.read(_RECORD.size))
                begin = file.tell()
                if begin + length > size and kind != _MCAP_CHUNK:
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
            self._scanned = file.seek(begin + length)
        raise DamageError  # no footer: the file is truncated

    def _note_record(self, kind: int, file: BinaryIO, at: int, length: int) -> None:
        """Register the record that begins at byte `at`. `file` is positioned at its content of `length` bytes."""
        begin = file.tell()
        if kind == _MCAP_CHUNK:
            _, _, _, crc = _CHUNK_HEAD.unpack(file.read(_CHUNK_HEAD.size))
            (letters,) = struct.unpack("<I", file.read(4))
            compression = file.read(min(letters, _LONGEST_NAME)).decode()
            (stored,) = struct.unpack("<Q", file.read(8))
            available = max(0, length - (file.tell() - begin))
            self.spans.append(Span(file.tell(), min(stored, available), compression, crc if stored <= available else 0))
        elif kind == _MCAP_INDEX and self.spans:
            channel, size = struct.unpack("<HI", file.read(6))
            size = min(size, length - 6)
            entries = np.frombuffer(file.read(max(0, size - size % _MCAP_INDEX_ENTRY.itemsize)), _MCAP_INDEX_ENTRY)
            self.spans[-1].tally.setdefault(channel, Tally()).add_stamps(entries["log_time"])
        elif kind == _MCAP_MESSAGE:
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
                if kind == _MCAP_MESSAGE:
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


# Reader of SQLite bags of ROS 2 (.db3).

SQLITE_MAGIC = b"SQLite format 3\x00"
_ROWS_AT_A_TIME = 64  # that `grown` holds in memory: 60 MB of images of 1 MB
# Types are checked, as a damaged database may contain any value.
_TOPICS = (
    "SELECT id, name, type, serialization_format FROM topics WHERE typeof(name) = 'text' AND typeof(type) = 'text'"
)


@final
class SqliteStorage:
    """Reader of a ROS 2 database. Rows are read in the order of ids, the order of writing, without an index. growing:
    the file is being written; only `grown` reads."""

    def __init__(self, path: Path, name: Path, growing: bool = False) -> None:
        self.path = path
        self.name = name
        self.notes: list[Remark] = []
        self._tally: dict[int, Tally] = {}
        self._last_id = -1  # id of the last usable message
        self._newest_id = -1  # id of the last message at the last call of `grown`
        self.connections: dict[int, Connection] = {}
        if growing:
            return
        try:
            with closing(self._connect()) as database:
                rows = database.execute(_TOPICS).fetchall()
        except sqlite3.OperationalError as error:
            raise RecordingError(f"{name} is a database, but not a ROS 2 bag ({error}); check the path.") from error
        except sqlite3.DatabaseError as error:
            raise RecordingError(f"{name} is a damaged database ({error}); copy or record it again.") from error
        self.connections = _connections(rows)
        self._count()

    def tally(self) -> dict[int, Tally]:
        return self._tally

    def messages(self, wanted: Set[int]) -> Iterator[tuple[int, int, bytes]]:
        marks = ",".join("?" * len(wanted))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE id <= ? AND topic_id IN ({marks}) ORDER BY id"
        hash_of(self.path).read_beside()
        with closing(self._connect()) as database:
            try:
                yield from database.execute(query, (self._last_id, *wanted))
            except sqlite3.DatabaseError as error:
                sentence = f"{self.name} is damaged ({error}); the messages after the damage were ignored."
                note = Remark("bag_damaged", sentence)
                if note not in self.notes:
                    self.notes.append(note)

    def grown(self) -> Iterator[tuple[int, int, bytes]]:
        """Messages as by `messages`, of all connections, since the last call. The newest ones are left to the next
        call: without locks, which would stop the writer, they may be read half written."""
        query = "SELECT topic_id, timestamp, data, id FROM messages WHERE id > ? AND id <= ? ORDER BY id LIMIT ?"
        with suppress(sqlite3.DatabaseError), closing(self._connect()) as database:
            self.connections = _connections(database.execute(_TOPICS).fetchall())
            until, self._newest_id = (
                self._newest_id,
                database.execute("SELECT max(id) FROM messages").fetchone()[0] or -1,
            )
            while rows := database.execute(query, (self._last_id, until, _ROWS_AT_A_TIME)).fetchall():
                yield from (row[:3] for row in rows if isinstance(row[2], bytes))
                self._last_id = rows[-1][3]

    def _count(self) -> None:
        page_bytes = _page_bytes_of_cut(self.path)
        wrong = self._tally_rows("CASE typeof(data) WHEN 'blob' THEN x'' END", 0)
        if wrong or page_bytes:  # read all contents: later pages may be missing
            wrong = self._tally_rows("data", page_bytes) or "the last pages are missing"
            self.notes.append(cut_note(self.name, f"({wrong})", self._tally))

    def _tally_rows(self, data: str, doubtful_bytes: int) -> str:
        """Count the messages before the first damage. Returns a description of the damage, empty if there is none.

        data: SQL expression for the content. The last messages, up to `doubtful_bytes`, are not counted: they may lie
        in a truncated page, whose missing part SQLite reads as zeros.
        """
        self._tally, self._last_id = {}, -1
        doubtful: deque[tuple[int, int, int, int]] = deque()  # id, topic, receive time [ns], size [bytes]
        total = 0
        try:
            with closing(self._connect()) as database:
                query = f"SELECT id, topic_id, timestamp, {data} FROM messages ORDER BY id"
                for key, topic, received_ns, content in database.execute(query):
                    if not (isinstance(topic, int) and isinstance(received_ns, int) and isinstance(content, bytes)):
                        return "a row makes no sense"
                    doubtful.append((key, topic, received_ns, len(content)))
                    total += len(content)
                    while doubtful and total - doubtful[0][3] >= doubtful_bytes:
                        self._last_id, topic, received_ns, size = doubtful.popleft()
                        self._tally.setdefault(topic, Tally()).add(1, received_ns, received_ns)
                        total -= size
        except sqlite3.DatabaseError as error:
            return str(error)
        return ""

    def _connect(self) -> sqlite3.Connection:
        # Without a write-ahead log, `immutable` avoids writing beside the database, which may be on a read-only disk.
        log = self.path.with_name(self.path.name + "-wal")
        options = "mode=ro" if log.exists() and log.stat().st_size else "mode=ro&immutable=1"
        # The garbage collector may close an unfinished query in another thread. Two threads never read at once.
        uri = f"{self.path.absolute().as_uri()}?{options}"
        database = sqlite3.connect(uri, uri=True, check_same_thread=False)
        database.execute("PRAGMA writable_schema=ON")  # allows a file shorter than its header states
        return database


def _connections(rows: list[tuple[int, str, str, str]]) -> dict[int, Connection]:
    return {key: Connection(topic, full_type(kind), form) for key, topic, kind, form in rows}


def _page_bytes_of_cut(path: Path) -> int:
    """Page size [bytes] if the database file is truncated (shorter than its header states), else 0."""
    with path.open("rb") as file:
        head = file.read(100)
    page_bytes = int.from_bytes(head[16:18]) if head[16:18] != b"\0\1" else 65536
    pages = int.from_bytes(head[28:32]) if head[24:28] == head[92:96] else 0  # else the count is invalid
    size = path.stat().st_size
    cut = size < pages * page_bytes or (page_bytes and size % page_bytes)
    return page_bytes if cut else 0


# ROS 1 bags, format 2.0: https://wiki.ros.org/Bags/Format/2.0.

ROS1_MAGIC = b"#ROSBAG V"
_VERSION = b"#ROSBAG V2.0\n"
_ROS1_MESSAGE, _BAG_HEADER, _ROS1_INDEX, _ROS1_CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_LARGEST_HEADER = 1 << 20  # bytes; headers have some hundred, a larger one is damage
_ROS1_INDEX_ENTRY = np.dtype([("secs", "<u4"), ("nsecs", "<u4"), ("offset", "<u4")])

Fields = dict[bytes, bytes]


@final
class Ros1Storage(SpanStorage):
    """Reader of a ROS 1 bag."""

    def _scan(self, file: BinaryIO, size: int) -> None:
        if not self._scanned and file.read(len(_VERSION)) != _VERSION:
            raise RecordingError(f"{self.name} is a bag older than format 2.0; convert it with `rosbag fix`.")
        file.seek(self._scanned or len(_VERSION))
        index_at = 0
        while (at := file.tell()) < size:
            try:
                fields, length = _read_header(file)
                kind = _kind(fields)
                if kind == _BAG_HEADER:
                    self._refuse_encrypted(fields)
                    index_at = _number("<Q", fields, b"index_pos")
                self._note_record(kind, fields, file, min(length, size - file.tell()))
                # The recorder writes the size of a chunk when it closes the chunk.
                is_open = self.growing and kind == _ROS1_CHUNK and not length
                complete = file.tell() + length <= size and not is_open
            except (struct.error, KeyError, UnicodeDecodeError) as error:
                file.seek(at)
                raise DamageError from error
            if not complete:
                file.seek(size)
                raise DamageError
            self._scanned = file.seek(length, 1)
        if not 0 < index_at <= size:  # position of the index, which the recorder writes last
            raise DamageError

    def _note_record(self, kind: int, fields: Fields, file: BinaryIO, length: int) -> None:
        """Register a record. `file` is positioned at its content of `length` bytes, before and after the call."""
        at = file.tell()
        if kind == _ROS1_CHUNK:
            self.spans.append(Span(at, length, fields[b"compression"].decode()))
        elif kind == _ROS1_INDEX and self.spans:
            entries = np.frombuffer(file.read(length - length % _ROS1_INDEX_ENTRY.itemsize), _ROS1_INDEX_ENTRY)
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
                elif kind == _ROS1_MESSAGE:
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
    if not _ROS1_MESSAGE <= kind <= _CONNECTION:
        raise struct.error
    return kind


def _number(form: str, fields: Fields, name: bytes) -> int:
    return struct.unpack(form, fields[name])[0]
