"""Topics and tables of a recording that can be position sensors: fixes, points, RTKLIB files, tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np

from icalib.data.messages import poses_and_twists
from icalib.data.recordings import Recording, TopicInfo
from icalib.sensors.position.read import RECEIVER_KINDS, first_kinds
from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.sensor import Sensor
from icalib.tools.inspection.facts import Key, KindInspector, SensorSource, Sources


class PositionInspector(KindInspector):
    """See `KindInspector`. Drafts comment these sensors out: a point may be anything, such as a goal that somebody
    clicked on."""

    sensor: ClassVar[type[Sensor]] = PositionSensor
    topic_kinds: ClassVar[tuple[str, ...]] = ("navsat", "point", "position", *RECEIVER_KINDS)
    prefix: ClassVar[str] = "gnss"
    plain_names: ClassVar[str] = (
        r"positions\.csv|[^/]*\.pos|.*\.(nmea|txt)|(gps|extended_)?fix|navsat(fix)?|navpvt|nmea(_sentence)?|point|position"
    )
    moves_with_wheels: ClassVar[bool] = True
    doubt: ClassVar[tuple[str, ...]] = (
        "Positions of something on the robot: an antenna, a prism, a tag? Then remove the #;",
        "the lever arm and the clock are calibrated (docs/rig-file.md#position-sensor).",
    )

    def sources(self, topics: Sequence[TopicInfo]) -> Iterator[tuple[Key, SensorSource]]:
        """See `KindInspector`. A receiver's messages are left out beside others that may hold the same fixes."""
        unused = {*RECEIVER_KINDS} - {*first_kinds(topics)}
        return super().sources([topic for topic in topics if topic.kind not in unused])

    def joined(self, recording: Recording, sources: Sources) -> Sources:
        """The sources; poses of a bag whose rotation is unknown or never changes are positions."""
        return sources.with_kind("position", lambda source: source.kind == "pose" and _points(recording, source))


def _points(recording: Recording, source: SensorSource) -> bool:
    pose, _ = poses_and_twists(recording, source.topic.name, source.topic.kind)
    good = np.abs(np.linalg.norm(pose[:, 3:], axis=1) - 1.0) < 1e-3
    moves, turns = ((part != part[:1]).any() for part in (pose[:, :3], pose[:, 3:]))
    return bool(2 * good.sum() < len(good) or (moves and not turns))


INSPECTOR = PositionInspector()
