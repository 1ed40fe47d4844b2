"""What of a recording can be a sensor: the base class of all kinds but IMUs and cameras.

Each kind has its own in `icalib.sensors.KIND.inspect`, under the name `INSPECTOR`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

from icalib.data.recordings import Recording, TopicInfo
from icalib.sensors import SENSOR_KINDS, facet
from icalib.sensors.sensor import Sensor
from icalib.tools.inspection.facts import Finding, Inspection


class KindInspector:
    """Says of one kind of sensor which topics can be one, and what a draft says of it.

    sensor: its class in a rig. topic_kinds: those of `TopicInfo`, tables included. prefix: of the names of sensors
    whose topic names none. plain_names: regular expression of parts of topics' names that say what is measured, and not
    by which sensor. is_certain: whether such a topic is a sensor on the robot; else its lines are comments in a draft,
    below `doubt`, unless nothing else gives the motion. moves_alone: whether it gives the motion without an IMU. rolls:
    whether it is on wheels on the ground.
    """

    sensor: ClassVar[type[Sensor]]
    topic_kinds: ClassVar[tuple[str, ...]]
    prefix: ClassVar[str]
    plain_names: ClassVar[str]
    is_certain: ClassVar[bool] = False
    doubt: ClassVar[tuple[str, ...]] = ()
    moves_alone: ClassVar[bool] = False
    rolls: ClassVar[bool] = False

    def facts(self, recording: Recording, name: str, topic: TopicInfo) -> Any:
        """What else can be said of the sensor: a dataclass, or None."""
        return None

    def findings(self, found: Inspection) -> Iterator[Finding]:
        """What is wrong with sensors of this kind."""
        yield from ()

    def lines(self, found: Inspection, name: str, topic: TopicInfo) -> Iterator[str]:
        """Fields of the sensor in a rig file, except its type and the place of its data."""
        yield from ()

    def more_lines(self, found: Inspection, shown: bool) -> Iterator[str]:
        """Sections of a rig file, from the name on, of sensors that are no topic of their own; comments unless
        `shown`."""
        yield from ()


def inspectors() -> dict[str, KindInspector]:
    """By the type of the sensor in a rig file, in the order of `SENSOR_KINDS`."""
    modules = {kind: facet(kind, "inspect") for kind in SENSOR_KINDS}
    return {kind: module.INSPECTOR for kind, module in modules.items() if module is not None}


def moving(found: Inspection) -> tuple[str, ...]:
    """Names of sensors that give the motion beside an IMU, cameras not counted."""
    kinds = inspectors()
    return tuple(name for name, source in found.sources.others.items() if kinds[source.kind].sensor.gives_motion)


def rolls(found: Inspection) -> bool:
    """Whether something that was recorded is on wheels on the ground."""
    kinds = inspectors()
    return any(kinds[source.kind].rolls for source in found.sources.others.values())


def without_imu(found: Inspection) -> tuple[str, ...]:
    """Names of sensors that need no IMU, cameras not counted; one that gives the motion alone first."""
    kinds = inspectors()
    free = [(n, kinds[s.kind]) for n, s in found.sources.others.items() if not kinds[s.kind].sensor.needs_imu]
    return tuple(name for name, _ in sorted(free, key=lambda x: not x[1].moves_alone))


def moves_without_imu(found: Inspection) -> bool:
    """Whether a sensor gives the motion without an IMU, and there is another one to calibrate; cameras not counted."""
    kinds, others = inspectors(), found.sources.others
    return len(without_imu(found)) > 1 and any(kinds[source.kind].moves_alone for source in others.values())


def nouns(alone: bool = False) -> str:
    """The kinds that give the motion beside an IMU, or `alone`, for a sentence."""
    kinds = [k for k in inspectors().values() if k.sensor.gives_motion and (k.moves_alone or not alone)]
    words = [k.sensor.noun for k in kinds]
    return " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
