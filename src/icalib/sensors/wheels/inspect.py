"""Inspection of a recording for wheels: topics of joints and twists, and tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from icalib.data.messages import poses_and_twists
from icalib.data.recordings import Recording, TopicInfo
from icalib.sensors.sensor import Sensor
from icalib.sensors.wheels.spec import Wheels
from icalib.tools.inspection.facts import Inspection, KindInspector, SensorSource, Sources, moves_on_floor


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

    def joined(self, recording: Recording, sources: Sources) -> Sources:
        """The sources; odometry that stays level and has velocities is that of wheels, whose scales and slip are then
        estimated. As poses it would say that the robot never tilts."""
        return sources.with_kind(
            "wheels", lambda source: source.topic.kind == "odometry" and _planar(recording, source)
        )

    def lines(self, inspection: Inspection, name: str, topic: TopicInfo) -> Iterator[str]:
        if topic.kind in ("twist", "odometry") or "twist" in topic.type:
            yield "measures: twist"
        if moves_on_floor(inspection):
            yield "ground: {plane: level, tilt_noise: 0.01}  # rad; without an IMU the floor must be flat"


def _planar(recording: Recording, source: SensorSource) -> bool:
    pose, twist = poses_and_twists(recording, source.topic.name, "odometry")
    level = (np.abs(pose[:, 2:5] - pose[:1, 2:3] * [1.0, 0.0, 0.0]) < 1e-6).all()
    return bool(level and (twist[:, [0, 5]] != 0.0).any())


INSPECTOR = WheelInspector()
