"""`Recording`: the interface of the program to recordings of all formats."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np

from icalib.base.remark import Remark
from icalib.data.images import DecodedImage, Payload, frames
from icalib.data.messages import MessageType, TopicInfo, UnreadType, choose_topic
from icalib.data.stamps import WHOLE_RECORDING, S, Span, Window, cut, stamps_inside
from icalib.data.tables import TableFile
from icalib.errors import RecordingError
from icalib.kinds import readers
from icalib.rig import Rig
from icalib.sensors.sensor import Sensor
from icalib.sensors.stream import Stream


class Cut(Protocol):
    """Function that returns a segment of `stream` without clock jumps. what: name of the stream in messages."""

    def __call__(self, stream: S, what: str) -> S: ...


class Recording(ABC):
    """One recording: topics with messages, tables of sensors, images. window: the part of it that is used.

    Each format has a subclass, which does not depend on kinds of sensors. The `read` module of a kind of sensor
    converts messages or tables to a stream and checks the values.
    """

    has_messages: ClassVar[bool] = False  # True: sensors are read from messages; False: from tables

    def __init__(self, root: Path, window: Window = WHOLE_RECORDING) -> None:
        self.root = root
        self.window = window
        self._read: list[Path] = []
        self._notes: list[Remark] = []
        self._sensors: tuple[Sensor, ...] = ()

    @abstractmethod
    def topics(self) -> tuple[TopicInfo, ...]:
        """All topics of the recording."""

    @abstractmethod
    def stamps(self, topic: str) -> np.ndarray:
        """(N,) int64 ns: raw stamps of all messages of `topic` in the window; for corners, one for each image.

        Raises RecordingError if the topic does not exist, icalib cannot read its type, or all messages are damaged.
        """

    def use_layouts(self, sensors: Sequence[Sensor]) -> None:
        """Use the table layouts of `sensors` (rig file). Call this before reading images or stamps, as images without
        timestamps may take the stamps of a table."""
        self._sensors = tuple(sensors)

    def topic(self, sensor: str, given: str | None, *kinds: str) -> TopicInfo:
        """The topic of a sensor, of one of `kinds`: `given`, else the only one whose name contains the name `sensor`,
        else the only one.

        Raises RecordingError listing the topics if none or several remain.
        """
        return choose_topic(str(self.root), self.topics(), sensor, given, *kinds)

    def messages(
        self, topic: str, kind: str, convert: Callable[[Any], Any] = lambda message: message
    ) -> Iterator[tuple[int, Any]]:
        """Stamp [ns] and `convert(message)` of each message of `topic`, in the order of the recording.

        A message has the fields of its ROS type. Damaged messages, and those for which `convert` raises ValueError, are
        rejected with a note. Raises RecordingError if the topic is missing or not of `kind` (`TopicInfo.kind`), or if
        all messages are damaged. This default is for recordings without messages, and raises.
        """
        raise RecordingError(f"{self.root} holds no messages, and {topic} should have some of {kind}; give a bag.")

    def received(self, topic: TopicInfo) -> np.ndarray:
        """(N, 2) int64 ns: stamp and receive time of each message, once all messages of the topic were read. This
        default, for recordings without receive times, is empty."""
        return np.zeros((0, 2), np.int64)

    def by_stamp(self, topic: str, stamps_ns: np.ndarray) -> np.ndarray:
        """(N,) indices that sort readings by stamp, with a note. This default, for formats with sorted data, changes
        nothing."""
        return np.arange(len(stamps_ns))

    @abstractmethod
    def find(self, path: str) -> Path | None:
        """The file of the table that the rig file gives as `path`; None if it does not exist."""

    @abstractmethod
    def table(self, sensor: Sensor, path: str, field: str = "path") -> Path:
        """As `find`, and adds the file to `files()`. Raises RecordingError if the file does not exist.

        field: the field of the rig file that the message names.
        """

    def inside(self, stream: S, path: Path) -> S:
        """The section of `stream`, read from the table at `path`, in the time window. Raises RecordingError if it is
        empty."""
        return cut(self.window, stream, f"{path} ({stream.name})", () if self.window.is_all else self._spans())

    def place(self, topic: str) -> str:
        """Name of a topic in messages."""
        return f"{self.root}/{topic}"

    def where(self, sensor: Sensor) -> str:
        """Name of the source of the sensor's data in messages, such as the file. Raises RecordingError without data."""
        source = readers()[sensor.sensor_type].source(self, sensor)
        return self.place(source.name) if isinstance(source, TopicInfo) else str(source)

    def image_topics(self) -> tuple[TopicInfo, ...]:
        """Topics of kind "image"."""
        return tuple(t for t in self.topics() if t.kind == "image")

    def image_topic(self, sensor: str, given: str | None) -> str:
        """Name of the topic with the images of a sensor, chosen as by `topic`. Raises RecordingError."""
        return self.topic(sensor, given, "image").name

    @abstractmethod
    def payloads(self, topic: str) -> Iterator[Payload]:
        """The undecoded images of `topic` in order, one at a time; `images.decode` decodes one, in any process.

        Stamps are strictly increasing, and all images have the same resolution. Images of zeros and repeated or late
        images are rejected; notes are added after the last image. Raises RecordingError as `checked_payloads`.
        """

    def images(self, topic: str) -> Iterator[DecodedImage]:
        """The decoded images of `topic`, checked as by `payloads`. Damaged images are rejected with a note."""
        return frames(self.payloads(topic), self.place(topic), self.note)

    def files(self) -> list[Path]:
        """Files read so far, without duplicates, in the order of reading."""
        return list(self._read)

    def note(self, sentence: Remark) -> None:
        """Add a sentence on rejected or repaired data to `notes()`, without duplicates."""
        if sentence not in self._notes:
            self._notes.append(sentence)

    def notes(self) -> tuple[Remark, ...]:
        """Sentences on data that were rejected or repaired so far."""
        return tuple(self._notes)

    def _remember(self, path: Path) -> None:
        if path not in self._read:
            self._read.append(path)

    def _spans(self) -> list[Span]:
        """First and last stamp [ns] of each topic with messages."""
        return [(t.first_ns, t.last_ns) for t in self.topics() if t.first_ns is not None and t.last_ns is not None]

    def _inside(self, stamps_ns: np.ndarray, where: str) -> np.ndarray:
        """(N,) bool: stamps [ns] in the time window. Raises RecordingError if there are none."""
        return stamps_inside(self.window, stamps_ns, where, self._spans())


class NewPart(ABC):
    """What was recorded between two looks at a recording that is being written. Parts can be pickled and joined."""

    @abstractmethod
    def recording(self, folder: Path) -> Recording:
        """The part as a recording; folder: an empty one, for the files that it may need."""

    @abstractmethod
    def without(self, topics: Set[str]) -> NewPart:
        """A copy without these topics, and without all images."""

    @abstractmethod
    def joined(self, others: Sequence[Any]) -> NewPart:
        """This part and `others` of the same class, which follow it."""


class Growing(Protocol):
    """A recording that is being written. Reading it writes nothing, and locks nothing.

    unread: by file or folder, a sentence on what cannot be followed.
    """

    unread: dict[Path, str]

    def part(self) -> NewPart | None:
        """What is new, up to PART_BYTES; None if nothing is. Raises OSError and RecordingError."""
        ...


PART_BYTES = 32 << 20
ReadStream = tuple[Stream, tuple[Remark, ...]]  # stream, notes on it
Progress = Callable[[str, float], None]  # called with the stage and the completed fraction, 0 to 1


@dataclass(frozen=True)
class Reading:
    """Functions for reading the sensors of `rig`.

    cut: applied to each stream, removes clock jumps. progress: shows the progress of long work.
    """

    rig: Rig
    cut: Cut
    progress: Progress = lambda *_: None


K = TypeVar("K", bound=Sensor)


@dataclass(frozen=True)
class Reader(Generic[K]):
    """How a kind of sensor is read from recordings.

    messages, tables: types of messages, and files of a folder, that it is read from. read: the checked stream of each
    sensor, with notes. source: the table, the topic, or words for the place of its data. unread: types of messages with
    its data in a form that is not read. needs_detection: whether `read` detects something in images, which takes long;
    the last argument tells whether the rig has a target.
    """

    messages: tuple[MessageType, ...]
    tables: tuple[TableFile, ...]
    read: Callable[[Recording, Sequence[K], Reading], list[ReadStream]]
    source: Callable[[Recording, K], Path | TopicInfo | str]
    unread: tuple[UnreadType, ...] = ()
    needs_detection: Callable[[Recording, K, bool], bool] = lambda *_: False
