"""Inspection of a recording for LiDARs: topics, point times, and their lines in a draft rig file."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from icalib.data.folder import CLOUD_FILES
from icalib.data.measurements import Measurements
from icalib.data.recordings import BagRecording, Recording, TopicInfo
from icalib.errors import CalibrationError, RecordingError
from icalib.rig import Rig, by_name
from icalib.sensors.lidar.initialize.boards import FEWEST_STOPS, sees_the_same
from icalib.sensors.lidar.initialize.surroundings import at_stops
from icalib.sensors.lidar.read import scans
from icalib.sensors.lidar.read.point_clouds import point_clouds, timing_fields
from icalib.sensors.lidar.spec import Lidar
from icalib.sensors.sensor import Sensor, TimeUnit
from icalib.tools.inspection.facts import (
    Facts,
    Finding,
    Inspection,
    KindInspector,
    Progress,
    SensorSource,
    Sources,
    independent,
    moving,
)


@dataclass(frozen=True)
class LidarFacts:
    """Findings on the clouds of one LiDAR. field, unit: point_time_field and point_time_unit that the rig file must
    give, None if they are detected from the data; problem: why `calibrate` would refuse the clouds, or empty."""

    field: str | None = None
    unit: TimeUnit | None = None
    problem: str = ""


def refused(inspection: Inspection) -> Iterator[Finding]:
    """LiDARs that `calibrate` would refuse: a problem if no other sensor gives the motion, else a warning. The draft of
    a rig that stops needs no times of points."""
    if inspection.rest is not None:
        return
    lidars = inspection.sources.of(Lidar.sensor_type)
    others = independent(inspection) or set(moving(inspection)) - lidars.keys()
    for name in lidars:
        if (facts := inspection.facts.get(name)) is not None and facts.problem:
            yield Finding("warning" if others else "problem", facts.problem)


def _rest(recording: Recording, sources: Sources, lidars: Sequence[str], views: Sequence[Any]) -> Finding | None:
    """What to say of the stops of LiDARs, alone or beside a target in `views` of cameras, if `calibrate` takes them.
    Clouds may lack the times of points, which do not matter at rest."""
    is_bag, chosen = isinstance(recording, BagRecording), []
    for name in lidars[: 1 if views else None]:
        place = sources.sensors[name].topic.name
        path, topic = ("", place) if is_bag else (place, None)
        chosen.append(Lidar(name, path, topic=topic, point_time="snapshot"))
    m = Measurements.of_streams(*(scans(recording, lidar) for lidar in chosen))
    if not views:
        (still,) = at_stops(Rig(by_name(*chosen)), [m])
        words = f"Stops found: {len(still.lidars[0].stamps_ns)}; the LiDARs are calibrated by surfaces that they share."
        return None if still is m else Finding("hint", words)
    count = max((view.stops for view in views if view.stops is not None), default=None)
    if count is None or not sees_the_same(m.lidars[0]):
        return None
    words = f"{lidars[0]} stands still, and the target is at rest in {count} place{'s' * (count != 1)}"
    if count < FEWEST_STOPS:
        return Finding("problem", f"{words}, too few; hold the board still for two seconds at each of ten places.")
    return Finding("hint", f"{words}; each is taken as a stop.")


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

    def searched(self, recording: Recording, inspection: Inspection, progress: Progress) -> Inspection:
        """Adds what to say of the stops of a rig of LiDARs, alone or beside cameras that see a target."""
        sources = inspection.sources
        lidars = [n for n, s in sources.of(Lidar.sensor_type).items() if s.topic.type != CLOUD_FILES]
        views = [view for f in inspection.facts.values() if (view := getattr(f, "view", None)) is not None]
        others = len(sources.sensors) - len(lidars)
        if not lidars or others != len(views) or (not views and len(lidars) < 2):
            return inspection
        try:
            return replace(inspection, rest=_rest(recording, sources, lidars, views))
        except CalibrationError:  # as findings say, or `calibrate`
            return inspection

    def lines(self, inspection: Inspection, name: str, topic: TopicInfo) -> Iterator[str]:
        """Lines of the draft rig file that name field and unit of the point times."""
        facts = inspection.facts.get(name)
        if facts is not None and facts.problem and inspection.rest is not None:
            yield "point_time: snapshot  # points have no times of their own, and need none at stops"
        if facts is not None and facts.field is not None:
            yield f"point_time_field: {json.dumps(facts.field)}  # looks like the time of each point"
        if facts is not None and facts.unit is not None:
            yield f"point_time_unit: {facts.unit}  # the only unit that fits the time between clouds"


INSPECTOR = LidarInspector()
