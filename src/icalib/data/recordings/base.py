"""What the rest of the program knows of a recording: this class and nothing else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np

from icalib.data.images.image_checks import frames
from icalib.data.images.images import DecodedImage, Payload
from icalib.data.measurements import CornerStream, TrackStream
from icalib.data.stamps.sections import S
from icalib.data.stamps.window import WHOLE, Span, Window, cut, stamps_inside
from icalib.data.topics import TopicInfo, choose_topic
from icalib.errors import RecordingError
from icalib.rig import Camera, Rig
from icalib.sensors import facet
from icalib.sensors.sensor import Sensor
from icalib.sensors.stream import Stream


class Cut(Protocol):
    """Keeps a part of a stream that `what` names in sentences, between jumps of its clock."""

    def __call__(self, stream: S, what: str) -> S: ...


class Recording(ABC):
    """One recording: topics with messages, tables of sensors, images.

    A reader of a format derives from this class. It knows its format only: each kind of sensor makes its stream from
    messages or a table (`read` in its folder), and checks what the numbers must satisfy.
    """

    has_messages: ClassVar[bool] = False  # whether sensors are read from messages; else from tables

    def __init__(self, root: Path, window: Window = WHOLE) -> None:
        self.root = root
        self.window = window
        self._read: list[Path] = []
        self._notes: list[str] = []
        self._sensors: tuple[Sensor, ...] = ()

    @abstractmethod
    def topics(self) -> tuple[TopicInfo, ...]:
        """What there is, by name."""

    @abstractmethod
    def stamps(self, topic: str) -> np.ndarray:
        """(N,) int64: the stamps of all messages of `topic`, as they were written; of corners, one for each image.

        Raises RecordingError where there is no such topic, icalib does not read its kind, or a message is damaged.
        """

    def use_layouts(self, sensors: Sequence[Sensor]) -> None:
        """Read tables as the rig file says: images without stamps may have theirs. Call this before images or stamps
        are read."""
        self._sensors = tuple(sensors)

    def topic(self, sensor: str, given: str | None, *kinds: str) -> TopicInfo:
        """The topic of the sensor's messages, of one of `kinds`: the one `given`, else the one with the sensor's name,
        else the only one.

        Raises RecordingError listing what there is where that leaves none or several.
        """
        return choose_topic(str(self.root), self.topics(), sensor, given, *kinds)

    def messages(
        self, topic: str, kind: str, convert: Callable[[Any], Any] = lambda message: message
    ) -> Iterator[tuple[int, Any]]:
        """Stamp [ns] and content of each message of `topic`, in the order of the recording; the content has the fields
        of the ROS type, or is what `convert` makes of the message. Messages that cannot be read, or of which `convert`
        raises ValueError, are left out with a note.

        Raises RecordingError where the topic is missing or not of `kind` (see TopicInfo), and where all are damaged.
        """
        del convert
        raise RecordingError(f"{self.root} holds no messages, and {topic} should have some of {kind}; give a bag.")

    def by_stamp(self, topic: str, stamps_ns: np.ndarray) -> np.ndarray:
        """(N,) the order of readings by stamp, where the recording may hold them in another; a note says so."""
        del topic
        return np.arange(len(stamps_ns))

    @abstractmethod
    def find(self, path: str) -> Path | None:
        """The table that the rig file gives as `path`; None where there is none."""

    @abstractmethod
    def table(self, sensor: Sensor, path: str, field: str = "path") -> Path:
        """As `find`, and remembers it as read. Raises RecordingError, which names the rig file's `field`, where there
        is none."""

    def inside(self, stream: S, path: Path) -> S:
        """What of the stream of the table at `path` is in the part of the recording that is used. Raises RecordingError
        where nothing is."""
        return cut(self.window, stream, f"{path} ({stream.name})", () if self.window.is_all else self._spans())

    def place(self, topic: str) -> str:
        """How a sentence names a topic."""
        return f"{self.root}/{topic}"

    def where(self, sensor: Sensor) -> str:
        """How a sentence names the place of the sensor's data, for example the file. Raises RecordingError where there
        are none."""
        return facet(sensor.sensor_type, "read").where(self, sensor)

    def image_topics(self) -> tuple[TopicInfo, ...]:
        """Those of images."""
        return tuple(t for t in self.topics() if t.kind == "image")

    def image_topic(self, camera: Camera) -> str:
        """The topic of the camera's images, as `topic`."""
        return self.topic(camera.name, camera.topic, "image").name

    @abstractmethod
    def payloads(self, topic: str) -> Iterator[Payload]:
        """The undecoded images of `topic` in order, one at a time; `images.decode` decodes one, in any process.

        Stamps increase strictly and the resolution is one. Images of zeros, repeated or late ones are left out, which
        the notes say once the last image was read. Raises RecordingError naming the topic, or the instant of an image.
        """

    def images(self, topic: str) -> Iterator[DecodedImage]:
        """The decoded images of `topic`, as `payloads`; damaged ones are left out, too, with a note."""
        return frames(self.payloads(topic), self.place(topic), self.note)

    def files(self) -> list[Path]:
        """The files that have been read so far, each once, in the order of reading."""
        return list(self._read)

    def note(self, sentence: str) -> None:
        """Keep a sentence on what was left out or repaired, each once."""
        if sentence not in self._notes:
            self._notes.append(sentence)

    def notes(self) -> tuple[str, ...]:
        """What was left out or repaired so far, one sentence each."""
        return tuple(self._notes)

    def _remember(self, path: Path) -> None:
        if path not in self._read:
            self._read.append(path)

    def _spans(self) -> list[Span]:
        """First and last stamp of each topic."""
        return [(t.first_ns, t.last_ns) for t in self.topics() if t.first_ns is not None and t.last_ns is not None]

    def _inside(self, stamps_ns: np.ndarray, where: str) -> np.ndarray:
        """(N,) bool, as `inside`."""
        return stamps_inside(self.window, stamps_ns, where, self._spans())


ReadStream = tuple[Stream, tuple[str, ...]]  # and notes on it
FindCorners = Callable[[Recording, Camera], tuple[CornerStream, tuple[str, ...]]]
FindTracks = Callable[[Recording, Sequence[Camera]], Sequence[tuple[TrackStream, tuple[str, ...]]]]


@dataclass(frozen=True)
class Reading:
    """How the sensors of `rig` are read. cut: applied to each stream; find, follow: find corners of one camera and
    feature tracks of several in their images."""

    rig: Rig
    cut: Cut
    find: FindCorners
    follow: FindTracks
