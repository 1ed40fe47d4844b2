"""Reads images, tables of corners and tables of feature tracks into checked streams of cameras."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from icalib.base.remark import Remark
from icalib.data.folder import PictureFolder
from icalib.data.images import Note, ignore
from icalib.data.messages import HasMessages, MessageType, UnreadType
from icalib.data.recording import Reader, Reading, ReadStream, Recording
from icalib.data.stamps import rate_sentence
from icalib.data.tables import STAMP, TableFile, TableKind, read_table
from icalib.detection.images import MOST_PICTURES
from icalib.errors import RecordingError
from icalib.geometry.targets import Target
from icalib.rig import PLAIN_TABLE, Rig
from icalib.sensors.camera.read.detected_corners import (
    CORNER_TABLE,
    IMAGE_RATE_HZ,
    CornerRows,
    ReadImages,
    checked_corners,
    find_corners,
    group_corners,
    image_starts,
    image_topic,
    in_image,
    outside_note,
    with_even_stamps,
)
from icalib.sensors.camera.read.image_tracks import find_all_tracks
from icalib.sensors.camera.spec import Camera
from icalib.sensors.camera.stream import CornerStream, TrackStream
from icalib.sensors.sensor import TableLayout

MESSAGES = (
    MessageType("sensor_msgs/msg/Image", "image"),
    MessageType("sensor_msgs/msg/CompressedImage", "image"),
    MessageType("sensor_msgs/msg/CameraInfo", "camera info", latched_suffix=""),
)
UNREAD = (
    UnreadType(
        r"\w+/msg/(CompressedVideo|FFMPEGPacket|H26[45]\w*)|theora_image_transport/msg/Packet",
        "image",
        "compressed video; decode it by its image transport, and record sensor_msgs/Image",
    ),
)


def _corner_stamps(path: Path, layout: TableLayout) -> np.ndarray:
    """(M,) int64 ns: one stamp for each image of the corner table at `path`."""
    return np.unique(read_table(path, CORNER_TABLE).integers[:, 0])


def _track_stamps(path: Path, layout: TableLayout) -> np.ndarray:
    """(M,) int64 ns: one stamp for each image of the track table at `path`."""
    return read_track_stamps(path)


TABLES = (
    TableFile("corners.csv", "table of corners", "corners", _corner_stamps),
    TableFile("tracks.csv", "table of tracks", "tracks", _track_stamps),
)


def read(recording: Recording, sensors: Sequence[Camera], reading: Reading) -> list[ReadStream]:
    """Streams of feature tracks, then of corners, each with notes, from tables or images of the cameras. Beside other
    sensors, images get even stamps, see `with_even_stamps`.

    Raises RecordingError if data are missing or cannot be read, or if two cameras share an image topic."""
    streams: list[ReadImages] = _tracks(recording, sensors, reading) + _corners(recording, sensors, reading)
    if reading.rig.cameras_alone or isinstance(recording, PictureFolder):
        return [*streams]
    names = {stream.name for stream, _ in streams}
    sources = {c.name: f"{source(recording, c)} ({c.name})" for c in sensors if c.name in names}
    return [*with_even_stamps(streams, sources)]


def source(recording: Recording, camera: Camera) -> str:
    """Text that names the source of the camera's corners in messages: its table, or its image topic. Without corners
    and images, that of its tracks."""
    if camera.tracks is not None and not sees(recording, camera):
        return str(recording.table(camera, camera.tracks, "tracks"))
    if has_corners(recording, camera):
        return str(recording.table(camera, camera.path))
    return recording.place(image_topic(recording, camera))


def has_corners(recording: Recording, camera: Camera) -> bool:
    """Whether corners of the camera are read from a table; otherwise they are detected in its images."""
    # Also true without table and images, so that the reader raises an error that names the missing table.
    return not recording.has_messages and (recording.find(camera.path) is not None or not recording.image_topics())


def needs_detection(recording: Recording, camera: Camera, has_target: bool) -> bool:
    """Whether corners or feature tracks of the camera are detected in its images, which takes long."""
    return camera.tracks_images or (has_target and not has_corners(recording, camera))


def sees(recording: Recording, camera: Camera) -> bool:
    """Whether the recording has images, or a corner table of the camera."""
    return bool(recording.image_topics()) or (
        has_corners(recording, camera) and recording.find(camera.path) is not None
    )


def corners(recording: Recording, camera: Camera, target: Target) -> CornerStream:
    """All corners of the camera's table, grouped by image, in temporal order.

    Raises RecordingError naming file and line or instant where the data are missing or cannot be read, where images are
    out of order, where a corner appears twice in an image, and where it is not on the target.
    """
    layout = camera.layout if camera.tracks is None else TableLayout(time_unit=camera.layout.time_unit)
    path = recording.table(camera, camera.path)
    table = read_table(path, CORNER_TABLE, layout, recording.note)
    stamps, tag, corner = (table.integers[:, k].copy() for k in range(3))
    rows = CornerRows(stamps, tag, corner, table.decimals)
    return recording.inside(group_corners(camera.name, str(path), rows, target), path)


def tracks(recording: Recording, camera: Camera) -> TrackStream:
    """Feature tracks of the camera, from the table at its `tracks`.

    Raises RecordingError as `read_tracks`, and if there is no such table.
    """
    assert camera.tracks is not None
    path = recording.table(camera, camera.tracks, "tracks")
    return recording.inside(read_tracks(camera.name, path, camera.resolution, camera.layout, recording.note), path)


def image_topics(recording: Recording, cameras: Sequence[Camera]) -> dict[str, str]:
    """Image topic by camera name. Raises RecordingError if two cameras would share a topic."""
    chosen: dict[str, str] = {}
    for camera in cameras:
        topic = image_topic(recording, camera)
        for other, taken in chosen.items():
            if taken == topic:
                raise RecordingError(
                    f"{camera.name} and {other} both match {topic}; set `topic` of each in the rig file."
                )
        chosen[camera.name] = topic
    return chosen


def image_sources(recording: Recording, rig: Rig) -> Iterable[tuple[str, str]]:
    """Name and image topic of each camera of which the recording has images. Raises RecordingError as
    `image_topics`."""
    return image_topics(recording, [c for c in rig.cameras if _has_images(recording, c)]).items()


def _has_images(recording: Recording, camera: Camera) -> bool:
    """Whether the recording has images of the camera. If its corners are in a table, the only image topic may be
    another camera's, so that its name must match."""
    try:
        topic = image_topic(recording, camera)
    except RecordingError:
        return False
    named = camera.topic is not None or camera.name in topic.split("/")
    return named or not has_corners(recording, camera)


def _tracks(recording: Recording, cameras: Sequence[Camera], reading: Reading) -> list[ReadImages]:
    """Track streams of the cameras with tracks, each with notes. Features of images are numbered above those of tables,
    so that they share none."""
    pictured = [c for c in cameras if c.tracks_images]
    tables = {c.name: tracks(recording, c) for c in cameras if c.tracks is not None and not c.tracks_images}
    image_topics(recording, pictured)
    above = 1 + max((int(t.feature.max(initial=-1)) for t in tables.values()), default=-1)
    what = f"tracking features in the images of {' and '.join(c.name for c in pictured)}"
    keep, pictures = reading.rig.settings.cache_corners, _pictures(reading.rig)
    of_recording = find_all_tracks(recording, pictured, keep, lambda done: reading.progress(what, done), pictures)
    of_images = {
        stream.name: (replace(stream, feature=stream.feature + above), notes) for stream, notes in of_recording
    }
    by_name = {name: (stream, ()) for name, stream in tables.items()} | of_images
    streams = [by_name[c.name] for c in cameras if c.name in by_name]
    return [(reading.cut(stream, f"the tracks of {stream.name}"), notes) for stream, notes in streams]


def _corners(recording: Recording, cameras: Sequence[Camera], reading: Reading) -> list[ReadImages]:
    """Checked corner streams of the cameras that may see the target, each with notes; none without a target."""
    target = reading.rig.target
    seeing = [c for c in cameras if reading.rig.has_target and (c.tracks is None or sees(recording, c))]
    pictured = [c for c in seeing if not has_corners(recording, c)]
    image_topics(recording, pictured)
    streams = []
    for camera in seeing:
        detected, notes = (
            _image_corners(recording, camera, reading)
            if camera in pictured
            else (corners(recording, camera, target), ())
        )
        where = recording.where(camera)
        cut = reading.cut(detected, f"{where} ({camera.name})")
        stream, dropped = checked_corners(cut, where, camera.resolution)
        streams.append((stream, notes + dropped))
    return streams


def _image_corners(recording: Recording, camera: Camera, reading: Reading) -> tuple[CornerStream, tuple[Remark, ...]]:
    """Target corners in the images of the camera, with notes."""
    rig, names = reading.rig, [c.name for c in reading.rig.of(Camera)]

    def show(done: float) -> None:
        share = (names.index(camera.name) + done) / len(names)
        reading.progress(f"finding the target in the images of {camera.name}", share)

    return find_corners(recording, camera, rig.target, rig.settings.cache_corners, show, _pictures(rig))


def _pictures(rig: Rig) -> int:
    """Most images of a camera that are kept to be shown."""
    return MOST_PICTURES if rig.settings.images_in_report else 0


# CameraInfo messages of ROS: resolution and intrinsics that a camera driver states.


@dataclass(frozen=True)
class CameraInfo:
    """Intrinsics that a driver states.

    resolution: (width, height) px; model: ROS name of the distortion model; distortion (n,): its coefficients; K (3, 3)
    px: camera matrix."""

    resolution: tuple[int, int]
    model: str
    distortion: np.ndarray
    K: np.ndarray


def read_camera_info(bag: HasMessages, topic: str) -> CameraInfo:
    """The first CameraInfo message of `topic`. Raises RecordingError as `BagRecording.messages` does."""
    _, m = next(bag.messages(topic, "camera info"))
    d, k = (m.D, m.K) if hasattr(m, "K") else (m.d, m.k)  # ROS 1, ROS 2
    return CameraInfo((m.width, m.height), m.distortion_model, np.array(d), np.array(k).reshape(3, 3))


# Reads a table of feature tracks into the checked track stream of one camera, grouped by image.

_TRACK_TABLE = TableKind(
    ("t [ns]", "feature"),
    ("u [px]", "v [px]"),
    (STAMP, (r"(feature|track|point|landmark)(_?id)?|id",), (r"u(_?px)?|x(_?px)?",), (r"v(_?px)?|y(_?px)?",)),
    IMAGE_RATE_HZ,
)
_TRACK_MARGIN_PX = 5.0  # accepted distance outside the image: a few times the noise of trackers


def read_track_stamps(path: Path) -> np.ndarray:
    """(M,) int64 ns: one stamp for each image of the table at `path`. Raises RecordingError as `read_table`."""
    return np.unique(read_table(path, _TRACK_TABLE).integers[:, 0])


def read_tracks(
    name: str, path: Path, resolution: tuple[int, int], layout: TableLayout = PLAIN_TABLE, note: Note = ignore
) -> TrackStream:
    """Feature tracks from the table t [ns], feature, u, v [px] at `path`.

    resolution: (width, height) px of the camera; note: called with a sentence on data that are left out. Raises
    RecordingError naming file and line or instant if the table cannot be read, images are out of order or at an
    impossible rate, a feature is twice in an image, many are outside the image, or no feature is in two images.
    """
    table = read_table(path, _TRACK_TABLE, layout)
    for sentence in table.notes:
        note(sentence)
    stamps_ns, feature, uv = table.integers[:, 0].copy(), table.integers[:, 1].copy(), table.decimals
    what = f"{path} ({name})"
    start = image_starts(what, stamps_ns)
    stream = TrackStream(name, stamps_ns[start[:-1]], start, feature, np.ascontiguousarray(uv))
    inside = in_image(stream.uv, resolution, _TRACK_MARGIN_PX)
    if not inside.all():
        first = stream.feature[np.argmin(inside)]
        note(outside_note(stream, inside, f"feature {first}", what, resolution))
        stream = _selected(stream, inside)
    _check(stream, what)
    return stream


def _selected(stream: TrackStream, kept: np.ndarray) -> TrackStream:
    """The observations that `kept` (N,) bool selects; images without such observations are left out."""
    count = np.bincount(stream.image[kept], minlength=len(stream.stamps_ns))
    has_rows = count > 0
    start = np.concatenate([[0], np.cumsum(count[has_rows])]).astype(np.int64)
    return TrackStream(stream.name, stream.stamps_ns[has_rows], start, stream.feature[kept], stream.uv[kept])


def _check(stream: TrackStream, what: str) -> None:
    """Raises RecordingError for a repeated feature, an impossible image rate, or if no feature is in two images."""
    key = np.lexsort((stream.feature, stream.image))
    repeated = key[1:][(np.diff(stream.feature[key]) == 0) & (np.diff(stream.image[key]) == 0)]
    if len(repeated):
        row = int(repeated.min())
        raise RecordingError(
            f"{what}: the image at {stream.stamps_ns[stream.image[row]]} ns has feature {stream.feature[row]} "
            "twice; remove one, for a feature is one point of the scene."
        )
    sentence = rate_sentence(what, stream.stamps_ns, *IMAGE_RATE_HZ) if len(stream.stamps_ns) > 1 else None
    if sentence:
        raise RecordingError(sentence)
    if np.unique(stream.feature).size == len(stream.feature):
        raise RecordingError(
            f"{what}: no feature is in more than one image; a point keeps its number from image to image."
        )


READER = Reader(MESSAGES, TABLES, read, source, UNREAD, needs_detection)
