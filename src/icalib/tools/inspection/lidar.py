"""How the points of LiDARs are timed, and what the rig file must say of it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping

from icalib.data.messages.clouds import timing_fields
from icalib.data.messages.streams import point_clouds
from icalib.data.recordings import BagRecording, Recording, TopicInfo
from icalib.errors import RecordingError
from icalib.rig import Lidar
from icalib.tools.inspection.facts import Finding, Inspection, LidarFacts


def lidar_facts(recording: Recording, lidars: Mapping[str, TopicInfo]) -> dict[str, LidarFacts]:
    """Of the LiDARs of a bag, by their first clouds."""
    if not isinstance(recording, BagRecording):
        return {}
    return {name: _facts(recording, Lidar(name, "", topic=topic.name)) for name, topic in lidars.items()}


def _facts(bag: BagRecording, lidar: Lidar) -> LidarFacts:
    assert lidar.topic is not None
    try:
        what = f"{bag.root} {lidar.topic} ({lidar.name})"
        return LidarFacts(*timing_fields(point_clouds(bag, lidar.topic), lidar, what))
    except RecordingError as error:
        return LidarFacts(None, None, str(error))


def untimed(found: Inspection) -> Iterator[Finding]:
    """LiDARs that `calibrate` would refuse: a problem where nothing else shows the motion."""
    others = found.sources.cameras or found.sources.poses
    for facts in found.lidars.values():
        if facts.problem:
            yield Finding("warning" if others else "problem", facts.problem)


def timing_lines(facts: LidarFacts | None) -> Iterator[str]:
    """Of the rig file."""
    if facts is not None and facts.field is not None:
        yield f"    point_time_field: {json.dumps(facts.field)}  # looks like the time of each point"
    if facts is not None and facts.unit is not None:
        yield f"    point_time_unit: {facts.unit}  # the only unit that fits the time between clouds"
