"""What a recording shows of its cameras, as plain data; figures that cannot be determined are None."""

from __future__ import annotations

from dataclasses import dataclass

from icalib.data.recordings import TopicInfo
from icalib.sensors.camera.read.camera_info import CameraInfo
from icalib.sensors.camera.spec import Camera
from icalib.tools.inspection.facts import Inspection, SensorSource, Vector


@dataclass(frozen=True)
class ImageFacts:
    """The images of one topic. resolution (width, height) px, encoding, frame: of the first image; decoded: number of
    sampled images; damaged: number of these that cannot be decoded."""

    resolution: tuple[int, int] | None
    encoding: str
    frame: str
    decoded: int
    damaged: int


@dataclass(frozen=True)
class TargetView:
    """Detections of the target in the images of one camera.

    images: their number, None if only corners were recorded; seen: number of images with the target; corners: number in
    all images. cells: number of corners in each cell of a grid over the image, row by row; None if the resolution is
    unknown. tilt_deg: 10th, 50th and 90th percentile of the angle between the optical axis and the target's normal;
    distance_ratio: 90th over 10th percentile of the distance. Both are rough, as the intrinsics are unknown.
    """

    camera: str
    images: int | None
    seen: int
    corners: int
    cells: tuple[tuple[int, ...], ...] | None
    tilt_deg: Vector | None
    distance_ratio: float | None
    notes: tuple[str, ...] = ()
    problem: str = ""


@dataclass(frozen=True)
class CameraFacts:
    """One camera. images: None without images; info: None without a readable CameraInfo. view: None if no target is
    known; pattern: then, words on the tags or checkerboard in a few images, "" for neither; None: not looked at."""

    images: ImageFacts | None = None
    info: CameraInfo | None = None
    view: TargetView | None = None
    pattern: str | None = None


@dataclass(frozen=True)
class CameraSource(SensorSource):
    """One camera: the topics of its images, corners, tracks (tables) and CameraInfo, or None. others: further topics of
    the same images. topic: the one that `calibrate` reads, which is corners, else images, else tracks."""

    images: TopicInfo | None
    corners: TopicInfo | None
    info: TopicInfo | None
    others: tuple[str, ...] = ()
    tracks: TopicInfo | None = None

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """See `SensorSource`."""
        return tuple(topic for topic in (self.images, self.corners) if topic)

    @property
    def read_topic(self) -> TopicInfo | None:
        """See `SensorSource`."""
        return self.images


def camera_sources(inspection: Inspection) -> dict[str, CameraSource]:
    """The cameras of a recording, by name."""
    return inspection.sources.of(Camera.sensor_type)


def camera_views(inspection: Inspection) -> dict[str, TargetView]:
    """The target as seen by cameras in whose images it was searched for, by name."""
    return {n: view for n in camera_sources(inspection) if (view := inspection.facts[n].view) is not None}


def patterns(inspection: Inspection) -> dict[str, str]:
    """`CameraFacts.pattern` of the cameras that were looked at, by name."""
    return {n: words for n in camera_sources(inspection) if (words := inspection.facts[n].pattern) is not None}


def without_target(inspection: Inspection) -> bool:
    """Whether there is an IMU and no camera shows a target, so that cameras can only track points of the scene."""
    words = patterns(inspection)
    return bool(inspection.imu and words) and not any(words.values())
