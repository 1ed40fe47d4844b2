"""Reads images, tables of corners and tables of feature tracks into checked streams of cameras."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from icalib.data.recordings.base import Reading, ReadStream, Recording
from icalib.data.tables.table import TableFile, read_table
from icalib.data.topics import MessageType, UnreadType
from icalib.errors import RecordingError
from icalib.geometry.targets import Target
from icalib.rig import Rig
from icalib.sensors.camera.read.checks import checked_corners
from icalib.sensors.camera.read.corners import CORNER_TABLE, CornerRows, group_corners
from icalib.sensors.camera.read.detected_corners import find_corners
from icalib.sensors.camera.read.even_images import ReadImages, with_even_stamps
from icalib.sensors.camera.read.image_tracks import find_all_tracks
from icalib.sensors.camera.read.images import image_topic
from icalib.sensors.camera.read.tracks import read_track_stamps, read_tracks
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
    del layout
    return np.unique(read_table(path, CORNER_TABLE).integers[:, 0])


def _track_stamps(path: Path, layout: TableLayout) -> np.ndarray:
    """(M,) int64 ns: one stamp for each image of the track table at `path`."""
    del layout
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
    if reading.rig.cameras_alone:
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
    keep = reading.rig.settings.cache_corners
    of_recording = find_all_tracks(recording, pictured, keep, lambda done: reading.progress(what, done))
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


def _image_corners(recording: Recording, camera: Camera, reading: Reading) -> tuple[CornerStream, tuple[str, ...]]:
    """Target corners in the images of the camera, with notes."""
    rig, names = reading.rig, [c.name for c in reading.rig.of(Camera)]

    def show(done: float) -> None:
        share = (names.index(camera.name) + done) / len(names)
        reading.progress(f"finding the target in the images of {camera.name}", share)

    return find_corners(recording, camera, rig.target, rig.settings.cache_corners, show)
