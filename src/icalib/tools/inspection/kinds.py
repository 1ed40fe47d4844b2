"""Base class of the inspectors, which recognise the sensors of one kind in a recording.

The inspector of a kind is `icalib.sensors.KIND.inspect.INSPECTOR`.

Formats values for the lines of a drafted rig file. Frame ids of messages.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import PurePosixPath
from typing import Any, ClassVar, Literal

import numpy as np
from rich.table import Table
from rich.text import Text

from icalib.base.input_files import VIDEO_FILE
from icalib.data.recordings import BagRecording, Recording, TopicInfo
from icalib.data.tables.table import table_files
from icalib.errors import RecordingError
from icalib.sensors import SENSOR_KINDS, facet
from icalib.sensors.sensor import Sensor
from icalib.tools.inspection.facts import Finding, FramePair, Inspection, SensorSource, Sources, StreamFacts

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

    def left_out(self, topics: Sequence[TopicInfo], sensors: Mapping[str, SensorSource]) -> dict[str, str]:
        """Topics of this kind that are not used, and why. sensors: all sensors by name."""
        return {}

    def joined(self, recording: Recording, sources: Sources) -> Sources:
        """The sources, in which topics that are parts of one sensor are joined, or belong to this kind by content."""
        return sources

    def read(self, recording: Recording, name: str, source: Any) -> tuple[StreamFacts, Any]:
        """Reads all messages of `source.read_topic`: facts on the stream, and on its content for `facts`."""
        raise NotImplementedError(type(self))

    def facts(self, recording: Recording, name: str, source: Any, content: Any) -> Any:
        """Facts on the sensor that are special to its kind: a dataclass, or None. content: result of `read`."""
        return content

    def searched(self, recording: Recording, inspection: Inspection, progress: Progress) -> dict[str, Any]:
        """Facts by name of sensors, once more, after the target was searched for in their data."""
        return {}

    def frames(self, recording: Recording) -> tuple[tuple[FramePair, ...], tuple[str, ...]]:
        """All pairs of frames with a transform in topics of `frame_topics`, sorted by topic and name. Also notes on
        topics that cannot be read."""
        return (), ()

    def draft(self, inspection: Inspection, active: bool) -> Iterator[str]:
        """Lines of the sensors of this kind in a rig file. Sensors that need not be on the robot are comments unless
        `active`."""
        for name, source in inspection.sources.of(self.sensor.sensor_type).items():
            if self.sensor.needs_imu and not inertial(inspection):
                continue
            is_active, topic = active or self.is_certain, source.topic
            yield from (f"  # {line}" for line in self.doubt if not is_active)
            lines = self.lines(inspection, name, topic)
            fields = (f"type: {source.kind}", place_line(topic.name, topic.type), *lines)
            for line in (f"{name}:", *(f"  {line}" for line in fields)):
                yield f"  {'' if is_active else '# '}{line}"
        yield from (f"  {line}" for line in self.more_lines(inspection, active))

    def lines(self, inspection: Inspection, name: str, topic: TopicInfo) -> Iterator[str]:
        """Lines of the sensor in a rig file, except its type and its topic or path."""
        yield from ()

    def more_lines(self, inspection: Inspection, active: bool) -> Iterator[str]:
        """Lines of a rig file for sensors without a topic of this kind, name included; comments unless `active`."""
        yield from ()

    def needs_target(self, inspection: Inspection) -> bool:
        """Whether a draft must give the target for sensors of this kind."""
        return False

    def figures(self, inspection: Inspection, name: str) -> dict[str, Any]:
        """Figures of one sensor as plain data, see `console.figures`."""
        source = inspection.sources.sensors[name]
        return {"type": source.kind, "topic": source.topic.name} | plain(inspection.facts.get(name))

    def readings_tables(self, inspection: Inspection) -> Iterator[Table]:
        """Tables of the readings for the terminal."""
        yield from ()

    def target_tables(self, inspection: Inspection) -> Iterator[Table | Text]:
        """Tables and text for the terminal on the target as the sensors see it."""
        yield from ()

    def notes(self, inspection: Inspection) -> Iterator[str]:
        """Notes on the search for the target, for the terminal."""
        yield from ()


def inspectors() -> dict[str, KindInspector]:
    """The inspectors by type of the sensor in a rig file, in the order of `SENSOR_KINDS`."""
    modules = {kind: facet(kind, "inspect") for kind in SENSOR_KINDS}
    return {kind: module.INSPECTOR for kind, module in modules.items() if module is not None}


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
    """Names of `dependent` sensors that need no IMU; those that give the motion without an IMU first."""
    free = dependent(inspection, lambda kind: not kind.sensor.needs_imu)
    alone = dependent(inspection, lambda kind: kind.moves_alone)
    return tuple(sorted(free, key=lambda name: name not in alone))


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


def plain(value: Any) -> dict[str, Any]:
    """The fields of a dataclass, arrays as lists; {} for None."""
    if value is None:
        return {}
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in dataclasses.asdict(value).items()}


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
