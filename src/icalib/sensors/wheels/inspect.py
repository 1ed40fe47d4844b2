"""Inspection of a recording for wheels: topics of joints and twists, and tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from icalib.data.recordings import TopicInfo
from icalib.sensors.sensor import Sensor
from icalib.sensors.wheels.spec import Wheels
from icalib.tools.inspection.facts import Inspection
from icalib.tools.inspection.kinds import KindInspector, moves_on_floor


class WheelInspector(KindInspector):
    """Drafts the rig file entry of wheels. Joints may belong to an arm, so that the draft asks the user (`doubt`)."""

    sensor: ClassVar[type[Sensor]] = Wheels
    topic_kinds: ClassVar[tuple[str, ...]] = ("joints", "twist", "wheels")
    prefix: ClassVar[str] = "wheel"
    plain_names: ClassVar[str] = r"(rates|angles|ticks|poses)\.csv|joint_states"
    doubt: ClassVar[tuple[str, ...]] = (
        "Are these wheels? Then remove the #, and give what they measure (docs/rig-file.md#wheels).",
    )
    rolls: ClassVar[bool] = True

    def lines(self, inspection: Inspection, name: str, topic: TopicInfo) -> Iterator[str]:
        """See `KindInspector`."""
        if topic.kind == "twist" or "twist" in topic.type:
            yield "measures: twist"
        if moves_on_floor(inspection):
            yield "ground: {plane: level, tilt_noise: 0.01}  # rad; without an IMU the floor must be flat"


INSPECTOR = WheelInspector()
