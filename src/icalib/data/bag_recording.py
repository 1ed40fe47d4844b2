"""Recordings that are bags of ROS 1 or ROS 2: one file, or a folder of files, found here."""

from __future__ import annotations

import re
import shutil
import struct
import tempfile
import weakref
from array import array
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, final

import numpy as np

from icalib.base.extras import load_typesys, load_zstd
from icalib.base.files import HEAD_BYTES, HashedFile, TooLargeError, copy_unpacked, not_data, regular, unpacked
from icalib.base.remark import Remark
from icalib.base.yaml_nodes import read_yaml
from icalib.data.bags import (
    MCAP_MAGIC,
    ROS1_MAGIC,
    SQLITE_MAGIC,
    Connection,
    McapStorage,
    Ros1Storage,
    SqliteStorage,
    Storage,
    Tally,
)
from icalib.data.images import Payload, checked_payloads, file_payload
from icalib.data.messages import MessageType, TopicInfo, choose_topic, find_topic, message_types
from icalib.data.recording import PART_BYTES, NewPart, Recording
from icalib.data.stamps import WHOLE_RECORDING, Span, Window
from icalib.errors import RecordingError, RigError
from icalib.sensors.sensor import Sensor

_SWAPPED_NS = 1_000_000_000  # largest lateness by transport; more means that the clock was set back


@final
class BagRecording(Recording):
    """A bag. Stamps are those of message headers, or the receive time if the stamp is zero or there is no header."""

    has_messages = True

    def __init__(self, root: Path, window: Window = WHOLE_RECORDING, storages: Sequence[Storage] | None = None) -> None:
        """storages: of the messages; None: the files at `root` are opened."""
        super().__init__(root, window)
        self._storages, self._notes = open_storages(root) if storages is None else ([*storages], [])
        self._topics = self._list_topics()
        self._received = self._received_ns()
        self._times: dict[TopicInfo, array[int]] = {}

    def _received_ns(self) -> Span:
        """Range of receive times [ns] of the messages in the time window, by the clock of the recorder. Raises
        RecordingError if the window begins after the last message."""
        spans = self._spans()
        if self.window.is_all or not spans:
            return -(2**63), 2**63 - 1
        origin, last = min(first for first, _ in spans), max(last for _, last in spans)
        low, high = self.window.bounds(origin)
        if low > last:
            raise self.window.refuse(str(self.root), (last - origin) * 1e-9)
        self.note(self.window.note(str(self.root)))
        return low, high

    def topics(self) -> tuple[TopicInfo, ...]:
        return self._topics

    def stamps(self, topic: str) -> np.ndarray:
        chosen = find_topic(str(self.root), self._topics, topic)
        if not chosen.kind:
            raise RecordingError(f"{self.root}: icalib does not read {chosen.type}; choose another topic than {topic}.")
        return np.array([stamp_ns for stamp_ns, _ in self._messages(chosen)], np.int64)

    def payloads(self, topic: str) -> Iterator[Payload]:
        where = f"{self.root} {topic}"
        images = (_payload(stamp, where, message) for stamp, message in self.messages(topic, "image"))
        return checked_payloads(images, where, self.note)

    def place(self, topic: str) -> str:
        return f"{self.root} {topic}"

    def find(self, path: str) -> Path | None:
        """Path of the table `path` in the folder of the bag; None if it does not exist."""
        table = self.root.parent / path
        return table if table.is_file() else None

    def table(self, sensor: Sensor, path: str, field: str = "path") -> Path:
        if (table := self.find(path)) is None:
            raise RecordingError(
                f"{self.root.parent / path} does not exist, and a bag holds no such table; put the table beside the "
                f"bag, or correct `{field}` of {sensor.name} in the rig file."
            )
        self._remember(table)
        return table

    def files(self) -> list[Path]:
        return [*(storage.name for storage in self._storages), *super().files()]

    def notes(self) -> tuple[Remark, ...]:
        damage = (note for storage in self._storages for note in storage.notes)
        return tuple(dict.fromkeys([*self._notes, *damage]))

    def messages(
        self, topic: str, kind: str, convert: Callable[[Any], Any] = lambda message: message
    ) -> Iterator[tuple[int, Any]]:
        chosen = choose_topic(str(self.root), self._topics, "", topic, kind)
        return self._messages(chosen, convert)

    def _messages(
        self, topic: TopicInfo, convert: Callable[[Any], Any] = lambda message: message
    ) -> Iterator[tuple[int, Any]]:
        total = unstamped = 0
        damaged: list[tuple[int, ValueError]] = []
        times = array("q")
        for received_ns, encoding, content in self._contents(topic):
            if encoding not in _stores():
                raise RecordingError(
                    f"{self.root} {topic.name}: messages have the encoding {encoding!r}, which is not one of "
                    "ROS; convert the bag."
                )
            total += 1
            try:
                message = _deserialise(encoding, content, message_types()[topic.type])
                converted = convert(message)
            except ValueError as error:
                damaged.append((received_ns, error))
                continue
            if not message_types()[topic.type].stamped:
                yield received_ns, converted
                continue
            stamp = message.header.stamp
            stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
            unstamped += not stamp_ns
            times.extend((stamp_ns or received_ns, received_ns))
            yield stamp_ns or received_ns, converted
        self._times[topic] = times
        if damaged:
            self._note_damage(topic.name, damaged, total)
        if unstamped:
            sentence = (
                f"{self.root} {topic.name}: {unstamped} messages have no stamp in their header. Their receive "
                "times are used instead, which are late and jittery; let the driver stamp each message."
            )
            self.note(Remark("messages_without_stamp", sentence))

    def _note_damage(self, topic: str, damaged: list[tuple[int, ValueError]], total: int) -> None:
        """Note on `damaged` messages (receive time [ns], error). Raises RecordingError if all `total` are damaged."""
        first_ns, error = damaged[0]
        if len(damaged) == total:
            others = ", and so are all others" if total > 1 else ""
            raise RecordingError(
                f"{self.root} {topic}: the message received at {first_ns} ns is damaged ({error}){others}; copy or "
                "record the bag again."
            ) from error
        sentence = (
            f"{self.root} {topic}: {len(damaged)} of {total} messages are damaged and were left out, the first "
            f"received at {first_ns} ns ({error})."
        )
        self.note(Remark("messages_damaged", sentence))

    def _contents(self, topic: TopicInfo) -> Iterator[tuple[int, str, bytes]]:
        """Receive time [ns], encoding and bytes of each message in the window, and of latched messages
        (`MessageType.latched_suffix`) at any time. Raises RecordingError if the window contains none."""
        low, high = self._received
        suffix = message_types()[topic.type].latched_suffix
        is_latched = suffix is not None and topic.name.endswith(suffix)
        is_any_inside = self.window.is_all
        for storage in self._storages:
            wanted = {k for k, c in storage.connections.items() if (c.topic, c.type) == (topic.name, topic.type)}
            for key, received_ns, content in storage.messages(wanted):
                if is_latched or low <= received_ns < high:
                    is_any_inside = True
                    yield received_ns, storage.connections[key].encoding, content
        if not is_any_inside and topic.count and topic.first_ns is not None and topic.last_ns is not None:
            origin = min(first for first, _ in self._spans())
            raise self.window.refuse(f"{self.root} {topic.name}", (topic.last_ns - origin) * 1e-9)

    def received(self, topic: TopicInfo) -> np.ndarray:
        return np.array(self._times.get(topic, ()), np.int64).reshape(-1, 2)

    def by_stamp(self, topic: str, stamps_ns: np.ndarray) -> np.ndarray:
        """(N,) indices that sort readings by stamp, with a note. No change if a reading is late by more than 1 s: the
        clock was set back, which later checks refuse."""
        back = np.diff(stamps_ns, prepend=stamps_ns[:1]) < 0
        late_ns = int((np.maximum.accumulate(stamps_ns) - stamps_ns).max()) if back.any() else 0
        if not 0 < late_ns <= _SWAPPED_NS:
            return np.arange(len(stamps_ns))
        sentence = (
            f"{self.root} {topic}: {int(back.sum())} readings are out of order by up to {late_ns * 1e-6:.1f} "
            "ms; all were sorted by stamp."
        )
        self.note(Remark("readings_out_of_order", sentence))
        return np.argsort(stamps_ns, kind="stable")

    def _list_topics(self) -> tuple[TopicInfo, ...]:
        tallies: dict[tuple[str, str], Tally] = {}
        for storage in self._storages:
            counted = storage.tally()
            for key, connection in storage.connections.items():
                part = counted.get(key, Tally())
                tallies.setdefault((connection.topic, connection.type), Tally()).add(
                    part.count, part.first_ns, part.last_ns
                )
        return tuple(_topic_info(*name, tally) for name, tally in sorted(tallies.items()))


def _topic_info(topic: str, name: str, tally: Tally) -> TopicInfo:
    first, last = (tally.first_ns, tally.last_ns) if tally.count else (None, None)
    known = message_types().get(name)
    return TopicInfo(topic, name, known.kind if known else "", tally.count, first, last)


def _payload(stamp_ns: int, where: str, message: Any) -> Payload:
    if hasattr(message, "format"):  # CompressedImage
        return file_payload(stamp_ns, where, message.data.tobytes(), message.format)
    return Payload(
        stamp_ns,
        where,
        message.encoding,
        message.data.tobytes(),
        message.width,
        message.height,
        message.step,
        bool(message.is_bigendian),
    )


@cache
def _stores() -> dict[str, Any]:
    """Deserializer of each encoding (ros1, cdr). The definitions of the types that icalib reads are the same in all ROS
    releases."""
    typesys = load_typesys()
    ros1, ros2 = (typesys.get_typestore(s) for s in (typesys.Stores.ROS1_NOETIC, typesys.Stores.ROS2_HUMBLE))
    for known in message_types().values():
        if known.definition:
            for store in (ros1, ros2):
                store.register(typesys.get_types_from_msg(known.definition, known.read_as or known.name))
    return {"ros1": ros1.deserialize_ros1, "cdr": ros2.deserialize_cdr}


def _deserialise(encoding: str, content: bytes, known: MessageType) -> Any:
    """The message of type `known`. Raises ValueError if `content` is damaged or of another type."""
    if content.startswith(ZSTD_MAGIC):  # ROS 2 can compress message by message
        content = _decompress(content)
    try:
        if encoding in known.parsers:
            return known.parsers[encoding](content)
        return _stores()[encoding](content, known.read_as or known.name)
    except (struct.error, IndexError, *_serde_errors()) as error:
        raise ValueError(str(error)) from error


def _decompress(content: bytes) -> bytes:
    zstd = load_zstd()
    try:
        return unpacked(zstd.ZstdDecompressor(), content)
    except zstd.ZstdError as error:
        raise ValueError(str(error)) from error


@cache
def _serde_errors() -> tuple[type[Exception], ...]:
    from rosbags.serde import SerdeError

    return (SerdeError,)


# Finds the files of a bag, and chooses the reader of each by its content.

_READERS = {ROS1_MAGIC: Ros1Storage, MCAP_MAGIC: McapStorage, SQLITE_MAGIC: SqliteStorage}
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_SUFFIXES = (".bag", ".active", ".mcap", ".db3", ".zstd")


def bag_files(folder: Path) -> list[Path]:
    """Bag files directly in `folder`, sorted by the numbers in their names: run_2.db3 before run_10.db3."""
    paths = [p for p in folder.iterdir() if p.is_file() and p.suffix in _SUFFIXES]
    return sorted(paths, key=lambda p: [int(t) if t.isdigit() else t for t in re.split(r"(\d+)", p.name)])


def open_storages(path: Path) -> tuple[list[Storage], list[Remark]]:
    """Readers of the bag file or folder `path`, and notes on missing and unreadable files of a folder.

    Raises RecordingError if no file can be read.
    """
    if not path.is_dir():
        return [open_storage(path)], []
    files = bag_files(path)
    notes = [
        Remark("bag_file_missing", f"{path}: metadata.yaml lists {name}, which does not exist.")
        for name in _absent(path)
    ]
    storages: list[Storage] = []
    for file in files:
        try:
            storages.append(open_storage(file))
        except RecordingError as error:
            if len(files) == 1:
                raise
            notes.append(Remark("bag_file_unreadable", str(error)))
    if not storages:
        raise RecordingError(f"{path}: none of its {len(files)} bag files can be read. {notes[-1]}")
    return storages, notes


def open_storage(path: Path, name: Path | None = None) -> Storage:
    """Reader of the bag file `path`. name: its name in messages; default: `path`. Raises RecordingError if the file is
    empty, damaged or no bag."""
    name = name or path
    try:
        with regular(path).open("rb") as file:
            head = file.read(HEAD_BYTES)
        if not head:
            raise RecordingError(f"{name} is empty; record or copy it again.")
        for magic, reader in _READERS.items():
            if head.startswith(magic):
                return reader(path, name)
        if head.startswith(ZSTD_MAGIC):
            return _open_compressed(path)
        if sentence := not_data(name, head):
            raise RecordingError(sentence)
    except OSError as error:
        raise RecordingError(
            f"{name} cannot be read ({error.strerror or error}); check the file and its permissions."
        ) from error
    raise RecordingError(
        f"{name} is neither a ROS 1 bag nor an MCAP file nor a ROS 2 database; "
        "give a .bag, .mcap or .db3 file, a folder that ROS 2 recorded, or a folder of tables."
    )


def _open_compressed(path: Path) -> Storage:
    """Reader of a file that ROS 2 compressed as a whole. It reads a temporary copy, deleted with the reader."""
    zstd = load_zstd()
    folder = tempfile.mkdtemp(prefix="icalib-")
    copy = Path(folder) / path.stem
    try:
        with HashedFile(path) as file, zstd.open(file, "rb") as packed, copy.open("wb") as out:
            copy_unpacked(packed, out, path.stat().st_size)
    except TooLargeError as error:
        shutil.rmtree(folder)
        raise RecordingError(f"{path}: {error}; unpack it with zstd -d and check its content.") from error
    except (zstd.ZstdError, EOFError):
        pass  # truncated: the reader of the copy notes how much is readable
    except OSError:
        shutil.rmtree(folder)
        raise
    try:
        if not copy.stat().st_size:
            raise RecordingError(f"{path} is truncated or damaged before its first message; copy or record it again.")
        storage = open_storage(copy, path)
    except RecordingError:
        shutil.rmtree(folder)
        raise
    weakref.finalize(storage, shutil.rmtree, folder)
    return storage


def _absent(folder: Path) -> list[str]:
    """Names of missing files that metadata.yaml lists; empty if it is missing or damaged, as nothing else needs it."""
    try:
        about = read_yaml(folder / "metadata.yaml").entries()["rosbag2_bagfile_information"].entries()
        names = [Path(item.text()).name for item in about["relative_file_paths"].items()]
    except (RigError, KeyError):
        return []
    present = {path.name for path in folder.iterdir()}
    return [n for n in names if not {n, n + ".zstd"} & present]


# Bags that are being written.


@dataclass
class MessagePart(NewPart):
    """Messages of a bag, as a `Storage`: connection, receive time [ns], content. connections: all that are known."""

    name: Path
    connections: dict[int, Connection]
    rows: list[tuple[int, int, bytes]]
    notes: list[Remark] = field(default_factory=list)

    def tally(self) -> dict[int, Tally]:
        total: dict[int, Tally] = {}
        for key, received_ns, _ in self.rows:
            total.setdefault(key, Tally()).add(1, received_ns, received_ns)
        return total

    def messages(self, wanted: Set[int]) -> Iterator[tuple[int, int, bytes]]:
        return (row for row in self.rows if row[0] in wanted)

    def recording(self, folder: Path) -> BagRecording:
        return BagRecording(self.name, storages=[self])

    def without(self, topics: Set[str]) -> MessagePart:
        kinds = {key: message_types().get(connection.type) for key, connection in self.connections.items()}
        left = {k for k, c in self.connections.items() if c.topic in topics or ((t := kinds[k]) and t.kind == "image")}
        return replace(self, rows=[row for row in self.rows if row[0] not in left])

    def joined(self, others: Sequence[MessagePart]) -> MessagePart:
        parts = (self, *others)
        return replace(parts[-1], rows=[row for part in parts for row in part.rows])


class GrowingBag:
    """A bag file that is being written, or a folder to which bag files are added."""

    def __init__(self, root: Path) -> None:
        self.unread: dict[Path, str] = {}
        self._root = root
        self._storages: dict[Path, McapStorage | Ros1Storage | SqliteStorage] = {}
        self._keys: dict[Connection, int] = {}  # numbers of connections in all files
        self._rows: Iterator[tuple[int, int, bytes]] = iter(())

    def part(self) -> MessagePart | None:
        """See `Growing`."""
        rows: list[tuple[int, int, bytes]] = []
        size = 0
        for is_new in (False, True):
            self._rows = self._new_rows() if is_new else self._rows
            for row in self._rows:
                rows.append(row)
                size += len(row[2])
                if size > PART_BYTES:
                    return self._part(rows)
        return self._part(rows) if rows else None

    def _part(self, rows: list[tuple[int, int, bytes]]) -> MessagePart:
        return MessagePart(self._root, {number: connection for connection, number in self._keys.items()}, rows)

    def _new_rows(self) -> Iterator[tuple[int, int, bytes]]:
        """Messages of all files since the last look. Copies that the recorder compressed as a whole are left out."""
        files = [p for p in bag_files(self._root) if p.suffix != ".zstd"] if self._root.is_dir() else [self._root]
        for path in files:
            if path not in self._storages and (opened := self._opened(path)) is not None:
                self._storages[path] = opened
            if (storage := self._storages.get(path)) is not None:
                for key, received_ns, content in storage.grown():
                    yield self._keys.setdefault(storage.connections[key], len(self._keys)), received_ns, content

    def _opened(self, path: Path) -> McapStorage | Ros1Storage | SqliteStorage | None:
        """Reader of a bag file; None while its first bytes are not there, or if they are not those of a bag."""
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
        self.unread.pop(path, None)
        for magic, reader in _READERS.items():
            if head.startswith(magic):
                return reader(path, path, growing=True)
        if not any(magic.startswith(head) for magic in _READERS):
            sentence = f"{path} is no bag that can be followed; give a .bag, .mcap or .db3 file, or a folder."
            self.unread[path] = sentence
        return None
