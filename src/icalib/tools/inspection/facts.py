"""Findings on a recording, as plain data; figures that cannot be determined are None.

Rates, gaps and jitter of stamps.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import PurePosixPath
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from rich.table import Table
from rich.text import Text

from icalib.base.files import VIDEO_FILE
from icalib.data.folder import CLOUD_FILES
from icalib.data.messages import listing, type_not_read
from icalib.data.recordings import BagRecording, Recording, TopicInfo
from icalib.data.stamps import longest_part
from icalib.data.tables import table_files
from icalib.errors import RecordingError
from icalib.geometry.targets import Target
from icalib.kinds import inspectors
from icalib.motion.poses import PPM
from icalib.report.page import Plot
from icalib.report.pictures import Drawing
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
class ClockRate:
    """Rate of the clock of receive times against that of header stamps, less 1, with its standard deviation [ppm]; in
    duration_s of stamps. Stamps of a clock that runs fast have a negative rate, as in `clock_rate` of a sensor."""

    ppm: float
    std_ppm: float
    duration_s: float


@dataclass(frozen=True)
class StreamFacts:
    """One topic. timing: None for topics that icalib does not read; problem: why it cannot be read, else "". content:
    words on the messages beside their type, such as the resolution of images. clock_rate: None without receive
    times."""

    topic: TopicInfo
    timing: Timing | None
    problem: str = ""
    content: str = ""
    clock_rate: ClockRate | None = None


@dataclass(frozen=True)
class SensorSource:
    """What a sensor is read from. kind: type of the sensor in a rig file; topic: the one that `calibrate` reads."""

    kind: str
    topic: TopicInfo

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics that are listed under the name of the sensor."""
        return (self.topic,)


@dataclass(frozen=True)
class Sources:
    """The sensors of a recording by name, those of a kind together; some may not be on the robot. left_out: topics
    that are not used, and why."""

    sensors: Mapping[str, SensorSource]
    left_out: Mapping[str, str] = field(default_factory=dict)

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
class Facts:
    """What the messages of a sensor show. facts: a dataclass of its kind, or None; stream: facts on the topic that was
    read in full; None: only stamps are read."""

    facts: Any = None
    stream: StreamFacts | None = None


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
    calibrate with; None without a readable one. rest: what to say of a rig that stops, in place of its motion."""

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
    rest: Finding | None = None

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


@dataclass(frozen=True)
class Draft:
    """Lines of the sensors of one kind in a rig file, and whether it must give the target for them."""

    lines: Iterable[str]
    needs_target: bool = False


@dataclass(frozen=True)
class Printout:
    """What the terminal shows of sensors of one kind: tables of their readings, then the target as they see it, then
    notes."""

    readings: Iterable[Table] = ()
    target: Iterable[Table | Text] = ()
    notes: Iterable[str] = ()


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


_CLOCK_PARTS = 10  # of a recording; 8 degrees of freedom, so that a false 5 sigma has a probability of 0.1 %
_MIN_PART = 5  # messages of which the least delay is taken


def clock_rate_of(times_ns: np.ndarray) -> ClockRate | None:
    """Rate of a clock from stamps and receive times (N, 2) int64 [ns]; None for too few messages.

    Messages are received late, never early. So the line goes through the least delay in each part of the recording
    (minimum-delay filtering; Zhang, Liu and Xia 2002); the scatter of these delays gives its standard deviation.
    """
    times_ns = times_ns[longest_part(times_ns[:, 0])[0]] if len(times_ns) else times_ns
    seconds = 1e-9 * (times_ns[:, 0] - times_ns[:1, 0])
    if len(seconds) < _CLOCK_PARTS * _MIN_PART or not np.ptp(seconds) > 0.0:
        return None
    delay, line, C = 1e-9 * (times_ns[:, 1] - times_ns[:, 0]), np.zeros(2), np.zeros((2, 2))
    for _ in range(2):  # the second time without the drift within a part
        off = delay - np.polyval(line, seconds)
        least = [part[np.argmin(off[part])] for part in np.array_split(np.arange(len(off)), _CLOCK_PARTS)]
        line, C = np.polyfit(seconds[least], delay[least], 1, cov=True)
    return ClockRate(float(line[0] / PPM), float(np.sqrt(C[0, 0]) / PPM), float(np.ptp(seconds)))


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


# Base class of the inspectors, which recognise the sensors of one kind in a recording.
#
# The inspector of a kind is `icalib.sensors.KIND.inspect.INSPECTOR`.
#
# Formats values for the lines of a drafted rig file. Frame ids of messages.

Key = tuple[str, ...]  # parts of the name of a topic that tell sensors apart
Subject = Literal["use", "quality", "clock", "gaps", "target"]
Progress = Callable[[str, float], None]  # called with the current step, and the progress of the whole, 0 to 1


class KindInspector:
    """Recognises sensors of one kind by their topics, and writes their lines in a draft of the rig file.

    sensor: class of the sensor in a rig. topic_kinds: values of `TopicInfo.kind` of its topics and tables. prefix: of
    names made up for sensors whose topic names none. plain_names: regular expression of parts of topic names that are
    the measured quantity, not the sensor. named_first: whether its sensors are named before others, whose names then
    get a number. is_certain: whether such a topic is always a sensor on the robot. If not, its lines are comments in a
    draft, below `doubt`, unless no other sensor gives the motion. moves_alone: whether the sensor gives the motion
    without an IMU. alone: what is calibrated of such sensors without any other, as a sentence; empty: nothing. rolls:
    whether it shows that the robot is on wheels on the ground. moves_with_wheels: whether the sensor gives the motion
    with wheels on a flat floor, without an IMU. frame_topics: values of `TopicInfo.kind` of topics with
    transforms between frames, whose stamps show no rate. sets_origin: whether times in tables may count from its first
    stamp. section: field of the JSON file with its figures. checks: functions that yield findings on sensors of this
    kind, by subject.
    """

    sensor: ClassVar[type[Sensor]]
    topic_kinds: ClassVar[tuple[str, ...]]
    prefix: ClassVar[str]
    plain_names: ClassVar[str]
    named_first: ClassVar[bool] = False
    is_certain: ClassVar[bool] = False
    doubt: ClassVar[tuple[str, ...]] = ()
    moves_alone: ClassVar[bool] = False
    alone: ClassVar[str] = ""
    rolls: ClassVar[bool] = False
    moves_with_wheels: ClassVar[bool] = False
    frame_topics: ClassVar[tuple[str, ...]] = ()
    sets_origin: ClassVar[bool] = False
    section: ClassVar[str] = "others"
    checks: ClassVar[Mapping[Subject, Callable[[Inspection], Iterator[Finding]]]] = {}

    def sources(self, topics: Sequence[TopicInfo]) -> Iterator[tuple[Key, SensorSource]]:
        """Yields the sensors of this kind among topics with messages, each with the key of its topic."""
        for topic in topics:
            if topic.kind in self.topic_kinds:
                yield topic_key(topic), SensorSource(self.sensor.sensor_type, topic)

    def joined(self, recording: Recording, sources: Sources) -> Sources:
        """The sources, in which topics that are parts of one sensor are joined, belong to this kind by content, or are
        left out."""
        return sources

    def read(self, recording: Recording, name: str, source: Any) -> Facts:
        """Reads the messages of the sensor as far as its kind has facts on them."""
        return Facts()

    def searched(self, recording: Recording, inspection: Inspection, progress: Progress) -> Inspection:
        """The inspection with what is searched for once all sensors are known: the target in images, transforms."""
        return inspection

    def draft(self, inspection: Inspection, active: bool) -> Draft:
        """Lines of the sensors of this kind in a rig file. Sensors that need not be on the robot are comments unless
        `active`."""
        return Draft(self._draft_lines(inspection, active))

    def _draft_lines(self, inspection: Inspection, active: bool) -> Iterator[str]:
        for name, source in inspection.sources.of(self.sensor.sensor_type).items():
            is_active, topic = active or self.is_certain, source.topic
            yield from (f"  # {line}" for line in self.doubt if not is_active)
            lines = self.lines(inspection, name, topic)
            fields = (f"type: {source.kind}", place_line(topic.name, topic.type), *lines)
            for line in (f"{name}:", *(f"  {line}" for line in fields)):
                yield f"  {'' if is_active else '# '}{line}"

    def pictures(self, inspection: Inspection) -> tuple[list[Plot], list[Drawing]]:
        """Plots and images that the page shows."""
        return [], []

    def lines(self, inspection: Inspection, name: str, topic: TopicInfo) -> Iterator[str]:
        """Lines of the sensor in a rig file, except its type and its topic or path."""
        yield from ()

    def figures(self, inspection: Inspection, name: str) -> dict[str, Any]:
        """Figures of one sensor as plain data, see `console.figures`."""
        source = inspection.sources.sensors[name]
        return {"type": source.kind, "topic": source.topic.name} | plain(inspection.facts.get(name))

    def printout(self, inspection: Inspection) -> Printout:
        """What the terminal shows of the sensors beside their topics."""
        return Printout()


@cache
def _plain_names() -> re.Pattern[str]:
    return re.compile("|".join(f"({kind.plain_names})" for kind in inspectors().values()))


def topic_key(topic: TopicInfo) -> Key:
    """The parts of a topic's name that name its sensor."""
    ending = PurePosixPath(topic.name).suffix if topic.type == VIDEO_FILE else ".csv"
    return tuple(p.removesuffix(ending) for p in topic.name.split("/") if p and not _plain_names().fullmatch(p))


def named(inspection: Inspection, accepted: Callable[[KindInspector], object]) -> tuple[str, ...]:
    """Names of the sensors whose kind is `accepted`."""
    kinds = {kind: inspector for kind, inspector in inspectors().items() if accepted(inspector)}
    return tuple(name for name, source in inspection.sources.sensors.items() if source.kind in kinds)


def inertial(inspection: Inspection) -> tuple[str, ...]:
    """Names of the IMUs."""
    return named(inspection, lambda kind: kind.sensor.is_inertial)


def independent(inspection: Inspection) -> tuple[str, ...]:
    """Names of sensors that can be calibrated without any other."""
    return named(inspection, lambda kind: kind.alone)


def dependent(inspection: Inspection, accepted: Callable[[KindInspector], object] = lambda _: True) -> tuple[str, ...]:
    """Names of sensors that need a sensor of another kind, if their kind is `accepted`; without IMUs."""
    return named(inspection, lambda kind: not (kind.sensor.is_inertial or kind.alone) and accepted(kind))


def beside_target(inspection: Inspection, name: str) -> bool:
    """Whether the sensor was at rest, beside cameras that may see a target: its clouds are files."""
    return bool(independent(inspection)) and inspection.sources.sensors[name].topic.type == CLOUD_FILES


def at_stops(inspection: Inspection) -> bool:
    """Whether all sensors were at rest: clouds of several LiDARs are files."""
    types = [source.topic.type for source in inspection.sources.sensors.values()]
    return len(types) > 1 and set(types) == {CLOUD_FILES}


def problem_of(inspection: Inspection, name: str) -> str:
    """Why the data of a sensor cannot be read; "" if they can."""
    return inspection.stream(inspection.sources.sensors[name].topic).problem


def moving(inspection: Inspection) -> tuple[str, ...]:
    """Names of `dependent` sensors that give the motion together with an IMU."""
    return dependent(inspection, lambda kind: kind.sensor.gives_motion)


def rolls(inspection: Inspection) -> bool:
    """Whether a recorded sensor shows that the robot is on wheels on the ground."""
    return bool(named(inspection, lambda kind: kind.rolls))


def without_imu(inspection: Inspection) -> tuple[str, ...]:
    """Names of `dependent` sensors; those that give the motion without an IMU first, and of these LiDARs."""
    alone = dependent(inspection, lambda kind: kind.moves_alone)
    lidars = dependent(inspection, lambda kind: kind.sensor.shows_planes)
    return tuple(sorted(dependent(inspection), key=lambda name: (name not in lidars, name not in alone)))


def moves_without_imu(inspection: Inspection) -> bool:
    """Whether a `dependent` sensor gives the motion without an IMU, and another one can be calibrated to it."""
    return len(without_imu(inspection)) > 1 and bool(dependent(inspection, lambda kind: kind.moves_alone))


def moves_on_floor(inspection: Inspection) -> bool:
    """Whether wheels and another sensor give the motion on a flat floor. False with an IMU, or a sensor that gives the
    motion alone."""
    better = inertial(inspection) or independent(inspection) or moves_without_imu(inspection)
    return not better and rolls(inspection) and bool(named(inspection, lambda kind: kind.moves_with_wheels))


def nouns(alone: bool = False) -> str:
    """Names of the kinds of sensors that give the motion, for a sentence; alone: only those that need no IMU for it."""
    kinds = [k for k in inspectors().values() if k.sensor.gives_motion and not k.alone and (k.moves_alone or not alone)]
    words = [k.sensor.noun for k in kinds]
    return " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


PICTURED = {"pictured": True}  # metadata of fields that only the page shows


def plain(value: Any) -> dict[str, Any]:
    """The fields of a dataclass, arrays as lists, without those in metadata `PICTURED`; {} for None."""
    if value is None:
        return {}
    left_out = {f.name for f in dataclasses.fields(value) if f.metadata == PICTURED}
    entries = {k: v for k, v in dataclasses.asdict(value).items() if k not in left_out}
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in entries.items()}


_PLAIN = re.compile(r"[A-Za-z0-9_./][A-Za-z0-9_./-]*")


def place_line(name: str, kind: str, frame: str = "") -> str:
    """The line `topic: NAME` for a topic of a bag or a folder of images, `path: NAME` for a table. kind, frame: type
    and frame id, for a comment."""
    endings = (".csv", *(PurePosixPath(table.name).suffix for table in table_files()))
    field = "path" if name.removesuffix(".gz").endswith(endings) else "topic"
    return f"{field}: {name_text(name)}  # {comment(kind)}" + in_frame(frame)


def in_frame(frame: str) -> str:
    """End of a comment with the frame id; "" without one."""
    return f", frame {json.dumps(frame)}" if frame else ""


def name_text(name: str) -> str:
    """The name of a topic or file, in quotes if YAML needs them."""
    return name if _PLAIN.fullmatch(name) else json.dumps(name)


def numbers(values: Iterable[float]) -> str:
    return f"[{', '.join(map(number, values))}]"


def number(value: float) -> str:
    return repr(float(value))


def comment(text: str) -> str:
    """`text` on one line, for a comment."""
    return " ".join(text.split())


def frame_id(recording: Recording, topic: TopicInfo) -> str:
    """The frame id of the first message; empty in folders."""
    if not isinstance(recording, BagRecording):
        return ""
    first: Iterator = recording.messages(topic.name, topic.kind)
    try:
        _, message = next(first)
    except (RecordingError, StopIteration):
        return ""
    return str(message.header.frame_id)


# Findings on a recording: what is wrong or missing for a calibration, and what to do.
#
# Findings on the set of recorded sensors: whether together they determine the motion, as `calibrate` requires. Topics
# of sensors in formats that icalib does not read.

_ORDER = ("problem", "warning", "hint")
_STAMP_MS = 1e-6  # resolution of stamps
_DRIFT_SIGMAS = 5.0  # standard deviations of a clock rate that is named


def findings(inspection: Inspection) -> tuple[Finding, ...]:
    """All findings: problems, then warnings, then hints."""
    every = [*missing_sensors(inspection), *unread(inspection), *_clock_rates(inspection)]
    for subject in get_args(Subject):
        every += _jumps(inspection) if subject == "gaps" else ()
        for kind in reversed(inspectors().values()):  # first of sensors that are compared with the IMU
            every += kind.checks[subject](inspection) if subject in kind.checks else ()
    return tuple(sorted(every, key=lambda f: _ORDER.index(f.severity)))


def _jumps(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on clocks that jump."""
    imus = {inspection.sources.sensors[name].topic for name in inertial(inspection)}  # their notes name jumps already
    for stream in inspection.streams:
        if stream.timing is not None and stream.timing.jumps and stream.topic not in imus:
            yield Finding(
                "warning",
                f"{stream.topic.name}: the clock jumps forward; the longest part between jumps is used, "
                f"{stream.timing.duration_s:.1f} s, unless --from and --to choose another.",
            )


def _clock_rates(inspection: Inspection) -> Iterator[Finding]:
    """Hints on header stamps that drift against the receive times."""
    for stream in inspection.streams:
        rate = stream.clock_rate
        drift_ms = 1e3 * PPM * abs(rate.ppm) * rate.duration_s if rate else 0.0
        if rate and drift_ms > _STAMP_MS and abs(rate.ppm) > _DRIFT_SIGMAS * rate.std_ppm:
            yield Finding(
                "hint",
                f"{stream.topic.name}: header stamps run {abs(rate.ppm):.3g} +- {rate.std_ppm:.2g} ppm "
                f"{'fast' if rate.ppm < 0.0 else 'slow'} against receive times, {drift_ms:.2g} ms over the recording; "
                "`icalib calibrate` estimates rates between clocks as clock_rate.",
            )


def missing_sensors(inspection: Inspection) -> Iterator[Finding]:
    """Findings on missing sensors, and on topics without messages."""
    topic_list = listing([s.topic for s in inspection.streams])
    if inertial(inspection):
        yield from _beside_an_imu(inspection, topic_list)
    elif inspection.rest is not None:
        yield inspection.rest
    elif independent(inspection):
        yield _independent_without_imu(inspection, topic_list)
    elif at_stops(inspection):
        yield Finding(
            "hint",
            "The clouds of a number or stamp are taken as a stop at which the rig stands still; the LiDARs are "
            "calibrated to each other by the surfaces that they share.",
        )
    elif moves_without_imu(inspection):
        yield Finding(
            "hint",
            "There is no IMU, so smooth motion is assumed, and all other sensors are calibrated relative to "
            f"{without_imu(inspection)[0]}.",
        )
    elif moves_on_floor(inspection):
        yield Finding(
            "hint",
            "There is no IMU, so smooth motion on a flat floor is assumed. The motion comes from "
            f"{' and '.join(without_imu(inspection))}.",
        )
    else:
        yield Finding("problem", f"{_alone(inspection)}: {topic_list}; {_wanted()}.")
    for stream in inspection.streams:
        if stream.topic.kind in ("image", "imu") and not stream.topic.count:
            yield Finding("warning", f"{stream.topic.name} holds no messages; check that this sensor was running.")


def _wanted() -> str:
    return (
        f"record the images of a camera, or an IMU with a {nouns()}, or a {nouns(alone=True)} with the sensors to "
        "calibrate"
    )


def _beside_an_imu(inspection: Inspection, topic_list: str) -> Iterator[Finding]:
    if independent(inspection) or moving(inspection) or inspection.moving_frames:
        return
    if others := dependent(inspection):
        names = " and ".join([*others, *inertial(inspection)])
        sentence = f"{names} do not determine the motion: {topic_list}; record a camera, a {nouns()} as well."
    else:
        sentence = (
            f"There is only an IMU: {topic_list}; record the images of a camera, or a {nouns()}. `icalib allan` "
            "estimates the noise of an IMU at rest."
        )
    yield Finding("problem", sentence)


def _independent_without_imu(inspection: Inspection, topic_list: str) -> Finding:
    kind = inspectors()[inspection.sources.sensors[independent(inspection)[0]].kind]
    if at_rest := [name for name in dependent(inspection) if beside_target(inspection, name)]:
        return Finding(
            "hint",
            f"Each image is taken as a stop at which the rig stands still, with the cloud of {' and '.join(at_rest)} "
            f"of the same number or stamp; the target must be in both.",
        )
    others = [*without_imu(inspection), *(f"frames of {topic}" for topic in inspection.moving_frames)]
    if others:
        return Finding(
            "hint",
            f"There is no IMU, so smooth motion is assumed, and {' and '.join(others)} are aligned to the "
            f"{kind.sensor.noun}s.",
        )
    return Finding(
        "warning",
        f"There is no IMU: {topic_list}. {kind.alone}; for more, record sensor_msgs/Imu, or write imu0/data.csv.",
    )


def _alone(inspection: Inspection) -> str:
    """Why sensors that need others cannot be calibrated without an IMU, as the begin of a sentence."""
    others = dependent(inspection)
    if not others:
        return "There is no sensor to calibrate"
    names = " and ".join(others)
    if dependent(inspection, lambda kind: kind.moves_alone):
        return f"Beside {without_imu(inspection)[0]} there is no sensor that can be calibrated without an IMU"
    return f"Without an IMU the motion is unknown from {names}"


def unread(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on topics with messages that icalib does not read, such as raw LiDAR packets and videos."""
    for stream in inspection.streams:
        if stream.topic.count and (content := type_not_read(stream.topic.type)):
            yield Finding("warning", f"{stream.topic.name} holds {content[1]}.")
