"""Findings on a recording, as plain data; figures that cannot be determined are None."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from icalib.data.recordings import TopicInfo
from icalib.geometry.targets import Target
from icalib.rig import TwoSources
from icalib.sensors.camera.read.camera_info import CameraInfo
from icalib.sensors.imu.read.checks import Saturation
from icalib.tools.inspection.kalibr import KalibrFiles

Severity = Literal["problem", "warning", "hint"]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Finding:
    """One sentence that says what is wrong or missing, and what to do.

    severity: "problem", no calibration is possible; "warning", it will be less accurate than it could be; "hint", for
    information.
    """

    severity: Severity
    sentence: str


@dataclass(frozen=True)
class Timing:
    """Statistics of the stamps of one stream, on the clock of its sensor.

    rate_hz: inverse of the median interval; jitter_s: RMS of the intervals about their median, without gaps. A gap is
    an interval longer than 1.5 medians; longest_gap_at_s: since the first stamp. backwards, repeated: number of stamps
    that are before, or equal to, their predecessor. jumps: number of forward jumps of the clock; all other fields are
    of the longest part between jumps.
    """

    count: int
    first_ns: int
    last_ns: int
    duration_s: float
    rate_hz: float | None
    jitter_s: float | None
    gaps: int
    longest_gap_s: float | None
    longest_gap_at_s: float | None
    backwards: int
    repeated: int
    jumps: int = 0


@dataclass(frozen=True)
class StreamFacts:
    """One topic. timing: None for topics that icalib does not read; problem: why it cannot be read, else ""."""

    topic: TopicInfo
    timing: Timing | None
    problem: str = ""


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
class ImuFacts:
    """Readings of one IMU, x y z in its axes: gyro [rad/s], accel [m/s^2], in the recorded units.

    frame: frame id. mean_accel: mean of |accel|. gyro_rms: RMS of each axis; accel_std: RMS about the mean.
    principal_rms: RMS rate about the directions `principal` (unit vectors), largest first. gravity_spread: result of
    `gravity_turns.gravity_spread` for rates taken as rad/s, as deg/s, and as zero. problem: why `calibrate` would
    refuse the readings, else "".
    """

    frame: str
    gyro_min: Vector
    gyro_max: Vector
    accel_min: Vector
    accel_max: Vector
    mean_accel: float
    gyro_rms: Vector
    accel_std: Vector
    principal_rms: Vector
    principal: tuple[Vector, Vector, Vector]
    gravity_spread: Vector | None
    saturated: tuple[Saturation, ...]
    notes: tuple[str, ...]
    problem: str = ""


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
class CameraSource:
    """One camera: the topics of its images, corners, tracks (tables) and CameraInfo, or None. others: further topics of
    the same images. topic: the one that `calibrate` reads, which is corners, else images, else tracks."""

    name: str
    topic: TopicInfo
    images: TopicInfo | None
    corners: TopicInfo | None
    info: TopicInfo | None
    others: tuple[str, ...] = ()
    tracks: TopicInfo | None = None


@dataclass(frozen=True)
class SensorSource:
    """A topic that can be a sensor. kind: type of the sensor in a rig file."""

    kind: str
    topic: TopicInfo


@dataclass(frozen=True)
class Sources:
    """The sensors of a recording by name. left_out: image topics that are not used, and why. others: sensors that are
    neither cameras nor IMUs, sorted by kind; some may not be on the robot. halves: the two topics of an IMU whose
    gyroscope and accelerometer have a topic each; `imus` has the gyroscope's."""

    cameras: tuple[CameraSource, ...]
    imus: Mapping[str, TopicInfo]
    left_out: Mapping[str, str]
    others: Mapping[str, SensorSource] = field(default_factory=dict)
    halves: Mapping[str, TwoSources] = field(default_factory=dict)

    def of(self, kind: str) -> dict[str, TopicInfo]:
        """Topics of the sensors in `others` of one kind, by name."""
        return {name: source.topic for name, source in self.others.items() if source.kind == kind}


@dataclass(frozen=True)
class FramePair:
    """A transform between two frames in `topic`. count: number of messages; rate_hz: None if sent once or static;
    moves: whether the transform changes."""

    topic: str
    parent: str
    child: str
    count: int
    rate_hz: float | None
    moves: bool


@dataclass(frozen=True)
class GivenTarget:
    """A target and its file; resolutions: (width, height) px of cameras by name, if the file is a rig file."""

    target: Target
    file: str
    resolutions: Mapping[str, tuple[int, int]]


@dataclass(frozen=True)
class Inspection:
    """Result of `inspect_recording`. images, infos, views: by name of the camera; imus: by name of the IMU; facts: by
    name of other sensors, a dataclass of the kind or None. imu: the IMU to calibrate with. shown: if no target is
    known, words on the tags or checkerboard in a few images of each camera, "" for neither."""

    recording: str
    sources: Sources
    streams: tuple[StreamFacts, ...]
    images: Mapping[str, ImageFacts]
    infos: Mapping[str, CameraInfo]
    imus: Mapping[str, ImuFacts]
    imu: str | None
    target: GivenTarget | None
    kalibr: KalibrFiles
    views: Mapping[str, TargetView] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
    frames: tuple[FramePair, ...] = ()
    shown: Mapping[str, str] = field(default_factory=dict)

    @property
    def without_target(self) -> bool:
        """Whether there is an IMU and no camera shows a target, so that cameras can only track points of the scene."""
        return bool(self.imus and self.shown) and not any(self.shown.values())

    @property
    def verdict(self) -> Literal["yes", "yes, but", "no"]:
        """Whether the recording can be calibrated: "no" with a problem, "yes, but" with a warning."""
        severities = {f.severity for f in self.findings}
        return "no" if "problem" in severities else "yes, but" if "warning" in severities else "yes"

    @property
    def moving_frames(self) -> tuple[str, ...]:
        """Topics of transforms that change."""
        return tuple(dict.fromkeys(f.topic for f in self.frames if f.moves))

    def stream(self, topic: TopicInfo) -> StreamFacts:
        return next(s for s in self.streams if s.topic == topic)
