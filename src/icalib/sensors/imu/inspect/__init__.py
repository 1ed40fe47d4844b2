"""Finds IMUs in a recording for `icalib inspect`: topics and tables of readings, and IMUs of two topics."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

from rich.table import Table

from icalib.data.recordings import Recording, TopicInfo
from icalib.errors import RecordingError
from icalib.sensors.imu.inspect import findings
from icalib.sensors.imu.inspect.draft import imu_lines
from icalib.sensors.imu.inspect.facts import ImuFacts, ImuSource
from icalib.sensors.imu.inspect.readings import imu_facts, read_imu
from icalib.sensors.imu.inspect.tables import imu_table
from icalib.sensors.imu.read.halves import pair_of
from icalib.sensors.imu.spec import ImuSensor
from icalib.sensors.sensor import Sensor
from icalib.tools.inspection.facts import Inspection, Sources, StreamFacts, timing_of
from icalib.tools.inspection.kinds import Key, KindInspector, frame_id, plain, topic_key


class ImuInspector(KindInspector):
    """Finds IMUs, and drafts the rig file entry of the one to calibrate with."""

    sensor: ClassVar[type[Sensor]] = ImuSensor
    topic_kinds: ClassVar[tuple[str, ...]] = ("imu",)
    prefix: ClassVar[str] = "imu"
    plain_names: ClassVar[str] = r"data(_raw)?|sample|data\.csv"
    is_certain: ClassVar[bool] = True
    sets_origin: ClassVar[bool] = True
    section: ClassVar[str] = "imus"
    checks: ClassVar = {"use": findings.refused, "quality": findings.of_readings, "gaps": findings.gaps}

    def sources(self, topics: Sequence[TopicInfo]) -> Iterator[tuple[Key, ImuSource]]:
        """See `KindInspector`."""
        return ((topic_key(t), ImuSource(self.sensor.sensor_type, t)) for t in topics if t.kind in self.topic_kinds)

    def joined(self, recording: Recording, sources: Sources) -> Sources:
        """The sources, in which the two topics or tables of one IMU (gyroscope, accelerometer) are joined to one IMU.
        Its name is the first free one of imu0, imu1, ..."""
        imus = sources.of(self.sensor.sensor_type)
        topics = tuple(imu.topic for imu in imus.values())
        pair = pair_of(recording, topics)
        if pair is None:
            return sources
        gyro = next(t for t in topics if t.name == pair.gyro)
        halves = {name for name, imu in imus.items() if imu.topic.name in (pair.gyro, pair.accel)}
        others = {name: source for name, source in sources.sensors.items() if name not in halves}
        name = next(n for k in itertools.count() if (n := f"imu{k}") not in others)
        return dataclasses.replace(sources, sensors={name: ImuSource(self.sensor.sensor_type, gyro, pair), **others})

    def read(self, recording: Recording, name: str, source: ImuSource) -> tuple[StreamFacts, ImuFacts | None]:
        """Reads all readings; no facts if they cannot be read."""
        topic = source.topic
        try:
            imu, where, notes = read_imu(recording, name, source.halves or topic.name)
        except RecordingError as error:
            return StreamFacts(topic, None, str(error)), None
        facts = imu_facts(imu, where, frame_id(recording, topic), notes)
        return StreamFacts(topic, timing_of(imu.stamps_ns), facts.problem), facts

    def draft(self, inspection: Inspection, active: bool) -> Iterator[str]:
        """Lines of the IMU to calibrate with."""
        return imu_lines(inspection, inspection.sources.of(self.sensor.sensor_type))

    def figures(self, inspection: Inspection, name: str) -> dict[str, Any]:
        """See `KindInspector`."""
        return {"topic": inspection.sources.sensors[name].topic.name} | plain(inspection.facts[name])

    def readings_tables(self, inspection: Inspection) -> Iterator[Table]:
        """Ranges and units of the readings."""
        imus = inspection.sources.of(self.sensor.sensor_type)
        if facts := {name: inspection.facts[name] for name in imus if inspection.facts[name] is not None}:
            yield imu_table(facts)


INSPECTOR = ImuInspector()
