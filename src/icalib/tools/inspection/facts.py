"""Findings on a recording, as plain data; figures that cannot be determined are None.

Rates, gaps and jitter of stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from icalib.data.recordings import TopicInfo
from icalib.data.stamps.jumps import longest_part
from icalib.errors import RecordingError
from icalib.geometry.targets import Target
from icalib.sensors.sensor import Sensor
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
    """One topic. timing: None for topics that icalib does not read; problem: why it cannot be read, else "". content:
    words on the messages beside their type, such as the resolution of images."""

    topic: TopicInfo
    timing: Timing | None
    problem: str = ""
    content: str = ""


@dataclass(frozen=True)
class SensorSource:
    """What a sensor is read from. kind: type of the sensor in a rig file; topic: the one that `calibrate` reads."""

    kind: str
    topic: TopicInfo

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics that are listed under the name of the sensor."""
        return (self.topic,)

    @property
    def read_topic(self) -> TopicInfo | None:
        """The topic whose messages are read in full; None: only stamps are read."""
        return None


@dataclass(frozen=True)
class Sources:
    """The sensors of a recording by name, those of a kind together; some may not be on the robot. left_out: topics
    that are not used, and why."""

    sensors: Mapping[str, SensorSource]
    left_out: Mapping[str, str]

    def with_kind(self, kind: str, chosen: Callable[[SensorSource], bool]) -> Sources:
        """These sources; those that are `chosen` by what they hold are of the sensor type `kind`. Unreadable ones stay
        what they are."""
        sensors = dict(self.sensors)
        for name, source in self.sensors.items():
            with suppress(RecordingError):
                sensors[name] = replace(source, kind=kind) if chosen(source) else source
        return replace(self, sensors=sensors)

    def of(self, kind: str) -> dict[str, Any]:
        """Sources of the sensors of one kind, by name; their class is that of the kind."""
        return {name: source for name, source in self.sensors.items() if source.kind == kind}


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
    """A target and its file; sensors: by name, if the file is a rig file."""

    target: Target
    file: str
    sensors: Mapping[str, Sensor] = field(default_factory=dict)


@dataclass(frozen=True)
class Inspection:
    """Result of `inspect_recording`. facts: by name of the sensor, a dataclass of its kind, or None. imu: the IMU to
    calibrate with; None without a readable one."""

    recording: str
    sources: Sources
    streams: tuple[StreamFacts, ...]
    facts: Mapping[str, Any]
    imu: str | None
    target: GivenTarget | None
    kalibr: KalibrFiles
    frames: tuple[FramePair, ...] = ()
    notes: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()

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


GAP = 1.5  # in median intervals; one lost message makes 2


def timing_of(stamps_ns: np.ndarray) -> Timing | None:
    """Statistics of the stamps (N,) int64 [ns], in the order of recording; None without stamps."""
    if not len(stamps_ns):
        return None
    part, jumps = longest_part(stamps_ns)
    stamps_ns = stamps_ns[part]
    first, last = int(stamps_ns.min()), int(stamps_ns.max())
    steps = np.diff(stamps_ns)
    forward = steps[steps > 0]
    median = float(np.median(forward)) if len(forward) else None
    wide = steps > GAP * median if median else np.zeros(len(steps), bool)
    longest = int(np.argmax(steps)) if wide.any() else None
    steps_without_gaps = forward[forward <= GAP * median] if median else forward
    return Timing(
        count=len(stamps_ns),
        first_ns=first,
        last_ns=last,
        duration_s=(last - first) * 1e-9,
        rate_hz=1e9 / median if median else None,
        jitter_s=1e-9 * float(np.sqrt(np.mean((steps_without_gaps - median) ** 2))) if median else None,
        gaps=int(wide.sum()),
        longest_gap_s=None if longest is None else float(steps[longest]) * 1e-9,
        longest_gap_at_s=None if longest is None else int(stamps_ns[longest] - first) * 1e-9,
        backwards=int((steps < 0).sum()),
        repeated=int((steps == 0).sum()),
        jumps=jumps,
    )


def overlap_s(a: Timing, b: Timing) -> float:
    """Overlap of the two spans of stamps [s]; negative: the gap between them."""
    return (min(a.last_ns, b.last_ns) - max(a.first_ns, b.first_ns)) * 1e-9


def words_on_gaps(t: Timing) -> str:
    """Number, length and instant of the gaps, for a sentence."""
    return (
        f"{t.gaps} gap{'s' * (t.gaps > 1)}, the longest of {t.longest_gap_s or 0.0:.3f} s at "
        f"{t.longest_gap_at_s or 0.0:.2f} s"
    )


def imu_timing(inspection: Inspection) -> Timing | None:
    """Statistics of the stamps of the IMU to calibrate with; None without one."""
    imu = inspection.imu
    return None if imu is None else inspection.stream(inspection.sources.sensors[imu].topic).timing
