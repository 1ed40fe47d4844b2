"""Inspection of a recording for LiDARs: topics, point times, and their lines in a draft rig file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from icalib.data.recordings import BagRecording, Recording, TopicInfo
from icalib.errors import RecordingError
from icalib.sensors.lidar.read.point_clouds import point_clouds, timing_fields
from icalib.sensors.lidar.spec import Lidar
from icalib.sensors.sensor import Sensor, TimeUnit
from icalib.tools.inspection.facts import Facts, Finding, Inspection, KindInspector, SensorSource, independent, moving


@dataclass(frozen=True)
class LidarFacts:
    """Findings on the clouds of one LiDAR. field, unit: point_time_field and point_time_unit that the rig file must
    give, None if they are detected from the data; problem: why `calibrate` would refuse the clouds, or empty."""

    field: str | None = None
    unit: TimeUnit | None = None
    problem: str = ""


def refused(inspection: Inspection) -> Iterator[Finding]:
    """LiDARs that `calibrate` would refuse: a problem if no other sensor gives the motion, else a warning."""
    lidars = inspection.sources.of(Lidar.sensor_type)
    others = independent(inspection) or set(moving(inspection)) - lidars.keys()
    for name in lidars:
        if (facts := inspection.facts.get(name)) is not None and facts.problem:
            yield Finding("warning" if others else "problem", facts.problem)


class LidarInspector(KindInspector):
    """Finds LiDARs and drafts their rig file entries. Every topic of point clouds is taken for a LiDAR on the robot."""

    sensor: ClassVar[type[Sensor]] = Lidar
    topic_kinds: ClassVar[tuple[str, ...]] = ("points",)
    prefix: ClassVar[str] = "lidar"
    plain_names: ClassVar[str] = r"scans\.npz|points(_raw)?|\*\.(pcd|ply|bin)"
    is_certain: ClassVar[bool] = True
    moves_alone: ClassVar[bool] = True
    checks: ClassVar = {"use": refused}

    def read(self, recording: Recording, name: str, source: SensorSource) -> Facts:
        """Findings from the first clouds of a bag; none from a folder."""
        if not isinstance(recording, BagRecording):
            return Facts()
        try:
            what = f"{recording.root} {source.topic.name} ({name})"
            lidar = Lidar(name, "", topic=source.topic.name)
            return Facts(LidarFacts(*timing_fields(point_clouds(recording, source.topic.name), lidar, what)))
        except RecordingError as error:
            return Facts(LidarFacts(problem=str(error)))

    def lines(self, inspection: Inspection, name: str, topic: TopicInfo) -> Iterator[str]:
        """Lines of the draft rig file that name field and unit of the point times."""
        facts = inspection.facts.get(name)
        if facts is not None and facts.field is not None:
            yield f"point_time_field: {json.dumps(facts.field)}  # looks like the time of each point"
        if facts is not None and facts.unit is not None:
            yield f"point_time_unit: {facts.unit}  # the only unit that fits the time between clouds"


INSPECTOR = LidarInspector()
