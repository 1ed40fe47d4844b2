"""Recordings that are bags of ROS 1 or ROS 2: one file, or a folder of them."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, final

import numpy as np

from icalib.base.extras import load_typesys, load_zstd
from icalib.base.unpacking import unpacked
from icalib.data.bags.opening import ZSTD_MAGIC, open_storages
from icalib.data.bags.storage import Tally
from icalib.data.checks.imu_halves import ImuHalves, imu_source, values_of
from icalib.data.images.image_checks import checked_payloads, frames
from icalib.data.images.images import DecodedImage, Payload, file_payload
from icalib.data.images.topics import KINDS, TopicInfo, choose_topic, find_topic
from icalib.data.measurements import CornerStream, ImuStream, LidarStream, TrackStream, WheelPoses
from icalib.data.messages import livox
from icalib.data.messages.clouds import read_clouds
from icalib.data.messages.streams import (
    point_clouds,
    read_joints,
    read_odometry,
    read_odometry_twists,
    read_poses,
    read_twists,
)
from icalib.data.recordings.transforms import (
    DEFAULT_TOPIC,
    MESSAGE,
    MESSAGE_TYPE,
    TRANSFORMS,
    read_transform_poses,
    refuse_without_frames,
)
from icalib.data.stamps.window import WHOLE, Span, Window, cut
from icalib.data.tables.poses import PoseReadings, read_pose_file
from icalib.data.tables.tracks import read_tracks
from icalib.data.tables.wheels import WheelReadings, read_wheel_joints, read_wheel_twists
from icalib.errors import RecordingError
from icalib.geometry.targets import Target
from icalib.rig import Camera, ImuSensor, Lidar, PoseSensor, TwoSources, Wheels

_SWAPPED_NS = 1_000_000_000  # readings overtake each other on the network by less; more is a clock that was set back


@final
class BagRecording:
    """A bag. Stamps are those of the messages' headers; where one is zero, when the message was received."""

    def __init__(self, root: Path, window: Window = WHOLE) -> None:
        self.root = root
        self._storages, self._notes = open_storages(root)
        self._topics = self._list_topics()
        self._window = window
        self._received = self._received_ns()
        self._tables: list[Path] = []

    def _received_ns(self) -> Span:
        """When the messages that are used were received, by the clock of the recorder. Raises RecordingError where
        nothing was recorded then."""
        found = self._spans()
        if self._window.is_all or not found:
            return -(2**63), 2**63 - 1
        origin, last = min(first for first, _ in found), max(last for _, last in found)
        low, high = self._window.bounds(origin)
        if low > last:
            raise self._window.refuse(str(self.root), (last - origin) * 1e-9)
        self._note(self._window.note(str(self.root)))
        return low, high

    def topics(self) -> tuple[TopicInfo, ...]:
        return self._topics

    def stamps(self, topic: str) -> np.ndarray:
        chosen = find_topic(str(self.root), self._topics, topic)
        if not chosen.kind:
            raise RecordingError(f"{self.root}: icalib does not read {chosen.type}; choose another topic than {topic}.")
        return np.array([stamp_ns for stamp_ns, _ in self._messages(chosen)], np.int64)

    def image_topic(self, camera: Camera) -> str:
        return choose_topic(str(self.root), self._topics, "image", camera.name, camera.topic).name

    def payloads(self, topic: str) -> Iterator[Payload]:
        where = f"{self.root} {topic}"
        found = (_payload(stamp, where, message) for stamp, message in self.messages(topic, "image"))
        return checked_payloads(found, where, self._note)

    def images(self, topic: str) -> Iterator[DecodedImage]:
        return frames(self.payloads(topic), f"{self.root} {topic}", self._note)

    def imu(self, sensor: ImuSensor) -> ImuStream | ImuHalves:
        source = self._imu_source(sensor)
        if isinstance(source, TwoSources):
            gyro_ns, gyro = self._readings(source.gyro)
            accel_ns, accel = self._readings(source.accel)
            return ImuHalves(sensor.name, gyro_ns, gyro[:, :3].copy(), accel_ns, accel[:, 3:].copy())
        stamps_ns, values = self._readings(source)
        return ImuStream(sensor.name, stamps_ns, values[:, :3].copy(), values[:, 3:].copy())

    def _readings(self, topic: str) -> tuple[np.ndarray, np.ndarray]:
        """(N,) stamps [ns] and (N, 6) readings of sensor_msgs/Imu, by stamp."""
        found = [(stamp, values_of(message)) for stamp, message in self.messages(topic, "imu")]
        stamps_ns = np.array([stamp for stamp, _ in found], np.int64)
        values = np.array([row for _, row in found], np.float64).reshape(-1, 6)
        order = self._order(topic, stamps_ns)
        return stamps_ns[order], values[order]

    def _imu_source(self, sensor: ImuSensor) -> str | TwoSources:
        return imu_source(str(self.root), self, self._topics, sensor)

    def use_layouts(self, sensors: Sequence[PoseSensor]) -> None:
        """Nothing here is a table."""

    def has_corners(self, camera: Camera) -> bool:
        return False

    def corners(self, camera: Camera, target: Target) -> CornerStream:
        raise RecordingError(
            f"{self.root} holds images of {camera.name}, not corners; detect the corners in its images first."
        )

    def sees(self, camera: Camera) -> bool:
        del camera
        return any(t.kind == "image" for t in self.topics())

    def tracks(self, camera: Camera) -> TrackStream:
        """A table beside the bag."""
        assert camera.tracks is not None
        path = self.root.parent / camera.tracks
        if not path.is_file():
            raise RecordingError(
                f"{path} does not exist, and a bag holds no feature tracks; put the table beside the bag, or "
                f"correct `tracks` of {camera.name} in the rig file."
            )
        self._tables.append(path)
        found = read_tracks(camera.name, path, camera.resolution, camera.layout, self._note)
        return cut(self._window, found, f"{path} ({camera.name})", self._spans())

    def lidar(self, sensor: Lidar) -> LidarStream:
        topic = self._topic(sensor)
        stream, notes = read_clouds(point_clouds(self, topic), sensor, f"{self.root} {topic} ({sensor.name})")
        for note in notes:
            self._note(note)
        return stream

    def wheels(self, sensor: Wheels) -> WheelReadings | WheelPoses:
        topic = self._wheel_topic(sensor)
        what = f"{self.root} {topic.name} ({sensor.name})"
        if topic.kind == "odometry":
            read = read_wheel_twists(sensor, read_odometry_twists(self, topic.name), what)
        elif topic.kind == "twist":
            read = read_wheel_twists(sensor, read_twists(self, topic.name), what)
        else:
            read = read_wheel_joints(sensor, read_joints(self, topic.name), what)
        order = self._order(topic.name, read.stamps_ns)
        return WheelReadings(sensor.name, read.stamps_ns[order], read.value[order])

    def poses(self, sensor: PoseSensor) -> PoseReadings:
        """Of a topic, a chain of transforms, or a table beside the bag."""
        if sensor.frames is not None:
            return read_transform_poses(self, sensor, self._note)
        if (table := self._pose_table(sensor)) is not None:
            self._tables.append(table)
            found = read_pose_file(sensor.name, table, sensor.layout, self._note)
            return cut(self._window, found, f"{table} ({sensor.name})", self._spans())
        topic = self._pose_topic(sensor)
        found = read_odometry(self, topic.name).pose if topic.kind == "odometry" else read_poses(self, topic.name)
        order = self._order(topic.name, found.stamps_ns)
        return PoseReadings(sensor.name, found.stamps_ns[order], found.rotation[order], found.position[order])

    def _spans(self) -> list[Span]:
        """When the messages of each topic were received: tables beside the bag often have the same clock."""
        return [(t.first_ns, t.last_ns) for t in self._topics if t.first_ns is not None and t.last_ns is not None]

    def _pose_table(self, sensor: PoseSensor) -> Path | None:
        table = self.root.parent / sensor.path
        return table if sensor.topic is None and sensor.frames is None and table.is_file() else None

    def _pose_topic(self, sensor: PoseSensor) -> TopicInfo:
        """An odometry's will do, too."""
        if sensor.frames is not None:
            return find_topic(str(self.root), self._topics, sensor.topic or DEFAULT_TOPIC)
        refuse_without_frames(self.root, self._topics, sensor)
        return self._choose(sensor, "pose", "odometry")

    def _wheel_topic(self, sensor: Wheels) -> TopicInfo:
        """Joints; of a twist its own, or that of an odometry."""
        kinds = ("twist", "odometry") if sensor.measures == "twist" else ("joints",)
        return self._choose(sensor, *kinds)

    def _choose(self, sensor: Wheels | PoseSensor, kind: str, *others: str) -> TopicInfo:
        """The sensor's topic of `kind`, or of one of the others, which will do, too."""
        alike = [replace(t, kind=kind) if t.kind in others else t for t in self._topics]
        chosen = choose_topic(str(self.root), alike, kind, sensor.name, sensor.topic)
        return find_topic(str(self.root), self._topics, chosen.name)

    def where(self, sensor: ImuSensor | Camera | Lidar | Wheels | PoseSensor) -> str:
        if isinstance(sensor, Camera):
            return f"{self.root} {self.image_topic(sensor)}"
        if isinstance(sensor, Wheels):
            return f"{self.root} {self._wheel_topic(sensor).name}"
        if isinstance(sensor, PoseSensor):
            return str(self._pose_table(sensor) or f"{self.root} {self._pose_topic(sensor).name}")
        if isinstance(sensor, ImuSensor):
            source = self._imu_source(sensor)
            shown = f"{source.gyro} and {source.accel}" if isinstance(source, TwoSources) else source
            return f"{self.root} {shown}"
        return f"{self.root} {self._topic(sensor)}"

    def files(self) -> list[Path]:
        return [*(storage.name for storage in self._storages), *self._tables]

    def notes(self) -> tuple[str, ...]:
        damage = (note for storage in self._storages for note in storage.notes)
        return tuple(dict.fromkeys([*self._notes, *damage]))

    def messages(
        self, topic: str, kind: str, convert: Callable[[Any], Any] = lambda message: message
    ) -> Iterator[tuple[int, Any]]:
        """Stamp [ns] and content of each message of `topic`, in the order of the bag; the content has the fields of the
        ROS type, or is what `convert` makes of the message. Messages that cannot be read, or of which `convert` raises
        ValueError, are damaged: they are left out, and a note counts them after the last message.

        Raises RecordingError listing what there is where the topic is missing or not of `kind` (see TopicInfo), and
        naming the first message where all are damaged.
        """
        chosen = choose_topic(str(self.root), self._topics, kind, "", topic)
        return self._messages(chosen, convert)

    def _messages(
        self, topic: TopicInfo, convert: Callable[[Any], Any] = lambda message: message
    ) -> Iterator[tuple[int, Any]]:
        total = unstamped = 0
        damaged: list[tuple[int, ValueError]] = []
        for received_ns, encoding, content in self._contents(topic):
            if encoding not in _stores():
                raise RecordingError(
                    f"{self.root} {topic.name}: messages have the encoding {encoding!r}, which is not one of "
                    "ROS; convert the bag."
                )
            total += 1
            try:
                message = _deserialise(encoding, content, topic.type)
                converted = convert(message)
            except ValueError as error:
                damaged.append((received_ns, error))
                continue
            if topic.kind == TRANSFORMS:  # of which each has a stamp
                yield received_ns, converted
                continue
            stamp = message.header.stamp
            stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
            unstamped += not stamp_ns
            yield stamp_ns or received_ns, converted
        if damaged:
            self._note_damage(topic.name, damaged, total)
        if unstamped:
            self._note(
                f"{self.root} {topic.name}: {unstamped} messages have no stamp in their header. Their receive "
                "times are used instead, which are late and jittery; let the driver stamp each message."
            )

    def _note_damage(self, topic: str, damaged: list[tuple[int, ValueError]], total: int) -> None:
        """`damaged`: when each was received [ns], and what is wrong. Raises RecordingError where these are all."""
        first_ns, error = damaged[0]
        if len(damaged) == total:
            others = ", and so are all others" if total > 1 else ""
            raise RecordingError(
                f"{self.root} {topic}: the message received at {first_ns} ns is damaged ({error}){others}; copy or "
                "record the bag again."
            ) from error
        self._note(
            f"{self.root} {topic}: {len(damaged)} of {total} messages are damaged and were left out, the first "
            f"received at {first_ns} ns ({error})."
        )

    def _contents(self, topic: TopicInfo) -> Iterator[tuple[int, str, bytes]]:
        """When it was received [ns], encoding and bytes of each message in the window; what does not change is often
        sent once only, and counts always."""
        low, high = self._received
        always = topic.kind == "camera info" or topic.name.endswith("tf_static")
        found = self._window.is_all
        for storage in self._storages:
            wanted = {k for k, c in storage.connections.items() if (c.topic, c.type) == (topic.name, topic.type)}
            for key, received_ns, content in storage.messages(wanted):
                if always or low <= received_ns < high:
                    found = True
                    yield received_ns, storage.connections[key].encoding, content
        if not found and topic.count and topic.first_ns is not None and topic.last_ns is not None:
            origin = min(first for first, _ in self._spans())
            raise self._window.refuse(f"{self.root} {topic.name}", (topic.last_ns - origin) * 1e-9)

    def _topic(self, sensor: Lidar) -> str:
        return choose_topic(str(self.root), self._topics, "points", sensor.name, sensor.topic).name

    def _order(self, topic: str, stamps_ns: np.ndarray) -> np.ndarray:
        """The order by stamp; as it is where the clock was set back, which the checks refuse."""
        back = np.diff(stamps_ns, prepend=stamps_ns[:1]) < 0
        late_ns = int((np.maximum.accumulate(stamps_ns) - stamps_ns).max()) if back.any() else 0
        if not 0 < late_ns <= _SWAPPED_NS:
            return np.arange(len(stamps_ns))
        self._note(
            f"{self.root} {topic}: {int(back.sum())} readings are out of order by up to {late_ns * 1e-6:.1f} "
            "ms; all were sorted by stamp."
        )
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

    def _note(self, sentence: str) -> None:
        if sentence not in self._notes:
            self._notes.append(sentence)


def _topic_info(topic: str, kind: str, tally: Tally) -> TopicInfo:
    first, last = (tally.first_ns, tally.last_ns) if tally.count else (None, None)
    return TopicInfo(topic, kind, KINDS.get(kind, ""), tally.count, first, last)


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
    """How the bytes of each encoding become a message. The types that icalib reads have not changed in any release."""
    typesys = load_typesys()
    ros1, ros2 = (typesys.get_typestore(s) for s in (typesys.Stores.ROS1_NOETIC, typesys.Stores.ROS2_HUMBLE))
    ros1.register(typesys.get_types_from_msg(MESSAGE, MESSAGE_TYPE))  # which rosbags knows of ROS 2 only
    return {"ros1": ros1.deserialize_ros1, "cdr": ros2.deserialize_cdr}


def _deserialise(encoding: str, content: bytes, kind: str) -> Any:
    """Raises ValueError where the bytes are not such a message."""
    if content.startswith(ZSTD_MAGIC):  # ROS 2 can compress message by message
        content = _decompress(content)
    try:
        if kind in livox.TYPES:
            return (livox.parse_ros1 if encoding == "ros1" else livox.parse_cdr)(content)
        return _stores()[encoding](content, MESSAGE_TYPE if KINDS.get(kind) == TRANSFORMS else kind)
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
