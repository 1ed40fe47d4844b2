"""What was found in a recording, as plain data; figures are None where they could not be had."""

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

    problem: no calibration can be made; warning: it will be worse than it could be; hint: good to know.
    """

    severity: Severity
    sentence: str


@dataclass(frozen=True)
class Timing:
    """The stamps of one stream, on its own clock.

    rate_hz: of the median interval; jitter_s: RMS of the intervals about their median, gaps left out. A gap is an
    interval longer than 1.5 medians; longest_gap_at_s is seconds after the first stamp. backwards, repeated: how many
    stamps are before, or the same as, the one in front of them. jumps: how often the clock jumps forward; all else is
    of the longest part between them.
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
    """One topic. timing: of the stamps of kinds that icalib reads. problem: the sentence where it cannot be read."""

    topic: TopicInfo
    timing: Timing | None
    problem: str = ""


@dataclass(frozen=True)
class ImageFacts:
    """The images of one topic: resolution (width, height) px, encoding and frame id of the first. Of a sample of
    `decoded` images, `damaged` cannot be decoded."""

    resolution: tuple[int, int] | None
    encoding: str
    frame: str
    decoded: int
    damaged: int


@dataclass(frozen=True)
class ImuFacts:
    """One IMU, x y z in its own axes: gyro [rad/s], accel [m/s^2], as they were written.

    mean_accel: mean of |accel|. gyro_rms: RMS of each axis; accel_std: RMS about the mean. principal_rms: RMS rate
    about the directions `principal` (unit vectors), from the strongest to the weakest. gravity_spread: see
    `imu.gravity_spread`, for rates in rad/s, in deg/s, and for none.
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
    """The target in the images of one camera.

    images, seen: how many there are (None: only the corners were recorded), and how many show the target. cells: number
    of corners in each cell of a grid over the image, row by row; None where the resolution is unknown. tilt_deg: 10th,
    50th and 90th percentile of the angle between the optical axis and the target's normal; distance_ratio: the farthest
    over the nearest, 90th over 10th percentile. Both without intrinsics, so roughly.
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
    """One camera: the topics of its images, of its corners and tracks (tables) and of its CameraInfo; others: more
    topics of the same images. topic: the corners where they were recorded, else the images, as `calibrate` takes them,
    or the tracks where there is nothing else."""

    name: str
    topic: TopicInfo
    images: TopicInfo | None
    corners: TopicInfo | None
    info: TopicInfo | None
    others: tuple[str, ...] = ()
    tracks: TopicInfo | None = None


@dataclass(frozen=True)
class SensorSource:
    """A topic that may be a sensor's. kind: type of the sensor in a rig file."""

    kind: str
    topic: TopicInfo


@dataclass(frozen=True)
class Sources:
    """The sensors of a recording by name; left_out: topics of images that are no camera's to calibrate, and why.
    others: of all other kinds, sorted by kind; some topics may be of something that is not on the robot. halves: both
    topics of an IMU whose gyroscope and accelerometer report apart; `imus` has the gyroscope's."""

    cameras: tuple[CameraSource, ...]
    imus: Mapping[str, TopicInfo]
    left_out: Mapping[str, str]
    others: Mapping[str, SensorSource] = field(default_factory=dict)
    halves: Mapping[str, TwoSources] = field(default_factory=dict)

    def of(self, kind: str) -> dict[str, TopicInfo]:
        """Those of `others` that are of one kind, by name."""
        return {name: source.topic for name, source in self.others.items() if source.kind == kind}


@dataclass(frozen=True)
class FramePair:
    """A transform between two frames of `topic`: how often it was sent, at what rate (None: once, or a static one), and
    whether it changes."""

    topic: str
    parent: str
    child: str
    count: int
    rate_hz: float | None
    moves: bool


@dataclass(frozen=True)
class GivenTarget:
    """A target and the file that it is from; resolutions: of cameras by name, where the file is a rig file."""

    target: Target
    file: str
    resolutions: Mapping[str, tuple[int, int]]


@dataclass(frozen=True)
class Inspection:
    """All that was found. images, infos and views are by camera, imus by IMU, facts by name of other sensors, each of
    a class of its kind, or None; imu: the one to calibrate with. shown: where no target is known, the tags or the board
    that a few images of each camera show, in words, "" for neither."""

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
        """Whether the cameras see no target, so that they can only track points of the scene, which takes an IMU."""
        return bool(self.imus and self.shown) and not any(self.shown.values())

    @property
    def verdict(self) -> Literal["yes", "yes, but", "no"]:
        """Can this be calibrated?"""
        found = {f.severity for f in self.findings}
        return "no" if "problem" in found else "yes, but" if "warning" in found else "yes"

    @property
    def moving_frames(self) -> tuple[str, ...]:
        """Topics of transforms that change."""
        return tuple(dict.fromkeys(f.topic for f in self.frames if f.moves))

    def stream(self, topic: TopicInfo) -> StreamFacts:
        return next(s for s in self.streams if s.topic == topic)
