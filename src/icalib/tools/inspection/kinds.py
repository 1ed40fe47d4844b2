"""Base class of the inspectors, which recognise the sensors of one kind in a recording; IMUs and cameras have none.

The inspector of a kind is `icalib.sensors.KIND.inspect.INSPECTOR`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

from icalib.data.recordings import Recording, TopicInfo
from icalib.sensors import SENSOR_KINDS, facet
from icalib.sensors.sensor import Sensor
from icalib.tools.inspection.facts import Finding, FramePair, Inspection


class KindInspector:
    """Recognises sensors of one kind by their topics, and writes their lines in a draft of the rig file.

    sensor: class of the sensor in a rig. topic_kinds: values of `TopicInfo.kind` of its topics and tables. prefix: of
    names made up for sensors whose topic names none. plain_names: regular expression of parts of topic names that are
    the measured quantity, not the sensor. is_certain: whether such a topic is always a sensor on the robot. If not, its
    lines are comments in a draft, below `doubt`, unless no other sensor gives the motion. moves_alone: whether the
    sensor gives the motion without an IMU. rolls: whether it shows that the robot is on wheels on the ground.
    frame_topics: values of `TopicInfo.kind` of topics with transforms between frames, whose stamps show no rate.
    """

    sensor: ClassVar[type[Sensor]]
    topic_kinds: ClassVar[tuple[str, ...]]
    prefix: ClassVar[str]
    plain_names: ClassVar[str]
    is_certain: ClassVar[bool] = False
    doubt: ClassVar[tuple[str, ...]] = ()
    moves_alone: ClassVar[bool] = False
    rolls: ClassVar[bool] = False
    frame_topics: ClassVar[tuple[str, ...]] = ()

    def facts(self, recording: Recording, name: str, topic: TopicInfo) -> Any:
        """Facts on the sensor that are special to its kind: a dataclass, or None."""
        return None

    def frames(self, recording: Recording) -> tuple[tuple[FramePair, ...], tuple[str, ...]]:
        """All pairs of frames with a transform in topics of `frame_topics`, sorted by topic and name. Also notes on
        topics that cannot be read."""
        return (), ()

    def findings(self, inspection: Inspection) -> Iterator[Finding]:
        """Findings on sensors of this kind."""
        yield from ()

    def lines(self, inspection: Inspection, name: str, topic: TopicInfo) -> Iterator[str]:
        """Lines of the sensor in a rig file, except its type and its topic or path."""
        yield from ()

    def more_lines(self, inspection: Inspection, active: bool) -> Iterator[str]:
        """Lines of a rig file for sensors without a topic of this kind, name included; comments unless `active`."""
        yield from ()


def inspectors() -> dict[str, KindInspector]:
    """The inspectors by type of the sensor in a rig file, in the order of `SENSOR_KINDS`."""
    modules = {kind: facet(kind, "inspect") for kind in SENSOR_KINDS}
    return {kind: module.INSPECTOR for kind, module in modules.items() if module is not None}


def moving(inspection: Inspection) -> tuple[str, ...]:
    """Names of sensors, without cameras, that give the motion together with an IMU."""
    kinds = inspectors()
    return tuple(name for name, source in inspection.sources.others.items() if kinds[source.kind].sensor.gives_motion)


def rolls(inspection: Inspection) -> bool:
    """Whether a recorded sensor shows that the robot is on wheels on the ground."""
    kinds = inspectors()
    return any(kinds[source.kind].rolls for source in inspection.sources.others.values())


def without_imu(inspection: Inspection) -> tuple[str, ...]:
    """Names of sensors, without cameras, that need no IMU; those that give the motion without an IMU first."""
    kinds = inspectors()
    free = [(n, kinds[s.kind]) for n, s in inspection.sources.others.items() if not kinds[s.kind].sensor.needs_imu]
    return tuple(name for name, _ in sorted(free, key=lambda x: not x[1].moves_alone))


def moves_without_imu(inspection: Inspection) -> bool:
    """Whether a sensor gives the motion without an IMU, and another one can be calibrated to it; without cameras."""
    kinds, others = inspectors(), inspection.sources.others
    return len(without_imu(inspection)) > 1 and any(kinds[source.kind].moves_alone for source in others.values())


def nouns(alone: bool = False) -> str:
    """Names of the kinds of sensors that give the motion, for a sentence; alone: only those that need no IMU for it."""
    kinds = [k for k in inspectors().values() if k.sensor.gives_motion and (k.moves_alone or not alone)]
    words = [k.sensor.noun for k in kinds]
    return " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
