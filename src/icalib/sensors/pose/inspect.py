"""Finds pose sensors in a recording for `icalib inspect`: topics and tables of poses or odometry, and frames of
transforms."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import ClassVar

from rich.table import Table
from rich.text import Text

from icalib.data.recordings import BagRecording, Recording, TopicInfo
from icalib.errors import RecordingError
from icalib.sensors.pose.read.transforms import TRANSFORMS, read_edges, transform_topics
from icalib.sensors.pose.spec import PoseSensor
from icalib.sensors.sensor import Sensor
from icalib.tools.inspection.console import plain_table
from icalib.tools.inspection.facts import (
    Draft,
    FramePair,
    Inspection,
    Key,
    KindInspector,
    Printout,
    Progress,
    SensorSource,
    inertial,
)


class PoseInspector(KindInspector):
    """Finds pose sensors. The draft rig file comments them out, as their poses may be computed from sensors of the same
    recording."""

    sensor: ClassVar[type[Sensor]] = PoseSensor
    topic_kinds: ClassVar[tuple[str, ...]] = ("pose", "odometry")
    prefix: ClassVar[str] = "pose"
    plain_names: ClassVar[str] = r"poses\.(csv|tum|txt)|pose|odom(etry)?"
    doubt: ClassVar[tuple[str, ...]] = (
        "Poses of something on the robot, and not computed from the sensors above? Then remove the #;",
        "absolute is motion capture, relative an odometry, which drifts (docs/rig-file.md#pose-sensor).",
    )
    moves_alone: ClassVar[bool] = True
    frame_topics: ClassVar[tuple[str, ...]] = (TRANSFORMS,)

    def sources(self, topics: Sequence[TopicInfo]) -> Iterator[tuple[Key, SensorSource]]:
        """See `KindInspector`; odometry comes last, as the first sensor gives the trajectory without an IMU."""
        return super().sources(sorted(topics, key=_drifts))

    def searched(self, recording: Recording, inspection: Inspection, progress: Progress) -> Inspection:
        """Adds pairs of frames of /tf and similar topics, sorted by topic and name, and notes on topics that cannot be
        read. There are none in recordings that are not bags."""
        if not isinstance(recording, BagRecording):
            return inspection
        topics = recording.topics()
        pairs, notes = list[FramePair](), list[str]()
        for name in sorted({t.name.removesuffix("_static") for t in topics if t.kind == TRANSFORMS and t.count}):
            try:
                edges = read_edges(recording, transform_topics(topics, name), notes.append)
            except RecordingError as error:
                notes.append(str(error))
                continue
            for (parent, child), e in sorted(edges.items()):
                pairs.append(FramePair(name, parent, child, len(e.stamps_ns), e.rate_hz, not e.static and e.changes))
        return replace(inspection, frames=tuple(pairs), notes=inspection.notes + tuple(notes))

    def lines(self, inspection: Inspection, name: str, topic: TopicInfo) -> Iterator[str]:
        """The `kind` line of the draft. Without an IMU the first pose sensor gives the trajectory, so it must be
        absolute."""
        leads = not inertial(inspection) and name == next(iter(inspection.sources.of(self.sensor.sensor_type)))
        yield f"kind: {'relative' if _drifts(topic) and not leads else 'absolute'}"

    def draft(self, inspection: Inspection, active: bool) -> Draft:
        active_chain = active and not inspection.sources.of(PoseSensor.sensor_type)
        return Draft((*super().draft(inspection, active).lines, *_chain_lines(inspection.frames, active_chain)))

    def printout(self, inspection: Inspection) -> Printout:
        return Printout(readings=[frames_table(inspection.frames)] if inspection.frames else [])


INSPECTOR = PoseInspector()


def _drifts(topic: TopicInfo) -> bool:
    return topic.kind == "odometry" or "odom" in topic.name


def _chain_lines(pairs: Sequence[FramePair], active: bool) -> Iterator[str]:
    """Draft lines of a pose sensor from transforms, if any transform changes; comments unless `active`. Its frames are
    the ends of the chain with most changing transforms."""
    chain = _most_motion(pairs)
    if not chain:
        return
    topic, frames = chain[0].topic, [chain[0].parent, chain[-1].child]
    kind = "relative" if "odom" in frames[0] else "absolute"
    if not active:
        yield "  # Poses from transforms, as of a robot arm? Then remove the #. Choose any two of the frames"
        yield "  # listed, the fixed one (base) and the moving one (docs/rig-file.md#pose-sensor)."
    place = (f"  topic: {json.dumps(topic)}", f"  frames: {json.dumps(frames)}")
    for line in ("tf0:", "  type: pose", *place, f"  kind: {kind}"):
        yield f"  {'' if active else '# '}{line}"


def _most_motion(pairs: Sequence[FramePair]) -> list[FramePair]:
    """Chain of frame pairs of one topic, from parent to child, that contains most changing transforms. It begins and
    ends with a changing one."""
    above = {(p.topic, p.child): p for p in pairs}
    best: list[FramePair] = []
    for last in pairs:
        if not last.moves:
            continue
        chain, visited = [last], {last.child}
        while (pair := above.get((last.topic, chain[0].parent))) is not None and pair.child not in visited:
            visited.add(pair.child)
            chain.insert(0, pair)
        first = next(k for k, pair in enumerate(chain) if pair.moves)
        best = max(best, chain[first:], key=lambda c: sum(pair.moves for pair in c))
    return best


def frames_table(pairs: Sequence[FramePair]) -> Table:
    """One row for each transform between two frames."""
    table = plain_table(
        "Frames",
        ("topic", "parent -> child", "count", "rate [Hz]", "moves"),
        right=2,
        caption="frames of a pose sensor: any two that these connect, parent and child.",
    )
    for f in pairs:
        rate = "" if f.rate_hz is None else f"{f.rate_hz:.1f}"
        cells = (f.topic, f"{f.parent} -> {f.child}", str(f.count), rate, "yes" if f.moves else "no")
        table.add_row(*map(Text, cells))
    return table
