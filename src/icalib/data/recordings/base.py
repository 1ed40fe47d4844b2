"""What the rest of the program knows of a recording: this class and nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from icalib.data.checks.imu_halves import ImuHalves
from icalib.data.images.images import DecodedImage, Payload
from icalib.data.images.topics import TopicInfo
from icalib.data.measurements import CornerStream, ImuStream, LidarStream, TrackStream, WheelPoses
from icalib.data.tables.poses import PoseReadings
from icalib.data.tables.wheels import WheelReadings
from icalib.geometry.targets import Target
from icalib.rig import Camera, ImuSensor, Lidar, PoseSensor, Wheels


class Recording(Protocol):
    """One recording. A reader knows its format only; `read_measurements` checks what the numbers must satisfy."""

    def topics(self) -> tuple[TopicInfo, ...]:
        """What there is, by name."""
        ...

    def stamps(self, topic: str) -> np.ndarray:
        """(N,) int64: the stamps of all messages of `topic`, as they were written; of corners, one for each image.

        Raises RecordingError where there is no such topic, icalib does not read its kind, or a message is damaged.
        """
        ...

    def use_layouts(self, sensors: Sequence[PoseSensor]) -> None:
        """Take the rig file's word for how tables of poses are written: images without stamps may have theirs. Call
        this before images or stamps are read."""
        ...

    def image_topic(self, camera: Camera) -> str:
        """The topic of the camera's images: its `topic`, else the one with its name, else the only one.

        Raises RecordingError listing what there is where that leaves none or several.
        """
        ...

    def payloads(self, topic: str) -> Iterator[Payload]:
        """The undecoded images of `topic` in order, one at a time; `images.decode` decodes one, in any process.

        Stamps increase strictly and the resolution is one. Images of zeros, repeated or late ones are left out, which
        the notes say once the last image was read. Raises RecordingError naming the topic, or the instant of an image.
        """
        ...

    def images(self, topic: str) -> Iterator[DecodedImage]:
        """The decoded images of `topic`, as `payloads`; damaged ones are left out, too, with a note."""
        ...

    def imu(self, sensor: ImuSensor) -> ImuStream | ImuHalves:
        """All readings of the IMU as they were written, or of its two sensors where they report apart: stamps may still
        repeat or run backwards.

        Raises RecordingError naming file and line, or topic, where the data are missing or cannot be read.
        """
        ...

    def has_corners(self, camera: Camera) -> bool:
        """Whether the camera's corners are there as a table; else they are to be found in its images."""
        ...

    def corners(self, camera: Camera, target: Target) -> CornerStream:
        """All corners that the camera saw, grouped by image, images in order.

        Raises RecordingError naming file and line or instant where the data are missing or cannot be read, where images
        are out of order, where a corner appears twice in an image, and where it is not on the target.
        """
        ...

    def sees(self, camera: Camera) -> bool:
        """Whether there are images or corners of the camera at all."""
        ...

    def tracks(self, camera: Camera) -> TrackStream:
        """The points of the scene that the camera followed, from the table at its `tracks`.

        Raises RecordingError as `tracks.read_tracks`, and where there is no such table.
        """
        ...

    def lidar(self, sensor: Lidar) -> LidarStream:
        """All scans of the LiDAR, points that cannot be used left out, which the notes say; a scan may have none.

        Raises RecordingError naming file or topic where the data are missing or cannot be read, and where the times of
        points are not known.
        """
        ...

    def wheels(self, sensor: Wheels) -> WheelReadings | WheelPoses:
        """All readings of the wheels as they were written: stamps may still repeat or run backwards.

        Raises RecordingError naming file and line, or topic, where the data are missing or cannot be read.
        """
        ...

    def poses(self, sensor: PoseSensor) -> PoseReadings:
        """All poses of the sensor as they were written: stamps may still repeat or run backwards.

        Raises RecordingError naming file and line, or topic, where the data are missing or cannot be read, and the
        instant of a rotation that is none.
        """
        ...

    def where(self, sensor: ImuSensor | Camera | Lidar | Wheels | PoseSensor) -> str:
        """How a sentence names the place of the sensor's data, for example the file."""
        ...

    def files(self) -> list[Path]:
        """The files that have been read so far, each once, in the order of reading."""
        ...

    def notes(self) -> tuple[str, ...]:
        """What the reader itself left out or repaired so far, one sentence each."""
        ...
