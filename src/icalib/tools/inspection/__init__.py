"""Inspection of a recording: its sensors, whether it can be calibrated, and a first draft of its rig file.

Reads a recording and collects its facts; `findings` derives problems and warnings from them.

Finds the topics that are sensors, and names the sensors. Reads the target that a user gives: a target or rig file of
icalib, or Kalibr's target file.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator, Sequence
from math import inf
from pathlib import Path
from typing import Any

from icalib.base.yaml_nodes import read_yaml
from icalib.data.recordings import Recording, Source, TopicInfo, open_recording
from icalib.errors import RecordingError, RigError
from icalib.geometry.targets import Scene
from icalib.kinds import inspectors
from icalib.rig.file import load_rig, load_target
from icalib.tools.inspection.facts import (
    Finding,
    GivenTarget,
    Inspection,
    Key,
    Progress,
    Sources,
    StreamFacts,
    clock_rate_of,
    comment,
    findings,
    independent,
    inertial,
    moves_on_floor,
    moves_without_imu,
    moving,
    named,
    nouns,
    number,
    problem_of,
    timing_of,
)
from icalib.tools.inspection.kalibr import KalibrFiles, find_kalibr_files, kalibr_target, yaml_mapping

__all__ = ["Finding", "GivenTarget", "Inspection", "draft_rig", "inspect_recording", "read_target"]


READING_SHARE = 0.3  # progress after reading, if the target is then searched for


def inspect_recording(
    source: Source,
    target: GivenTarget | None = None,
    progress: Progress = lambda *_: None,
    *,
    start_s: float = 0.0,
    end_s: float = inf,
) -> Inspection:
    """Reads the recording `source`: its sensors, and whether it can be calibrated. start_s, end_s: part that is read,
    s after the start, unless it is opened already.

    The `target`, or that of a Kalibr file beside the recording, is searched for in all images; `calibrate` uses the
    found corners again. Raises RecordingError, one sentence, if there is no recording or it is empty. Faults of single
    topics become findings.
    """
    if isinstance(source, Recording):  # opened again, so that notes of this reading are not in the caller's
        source, start_s, end_s = source.root, source.window.start_s, source.window.end_s
    path, recording = Path(source), open_recording(source, start_s, end_s)
    topics = recording.topics()
    if not any(t.count for t in topics):
        raise RecordingError(
            f"{path} holds no messages, images or tables; give a bag, or a folder with imu0/data.csv and cam0/data."
        )
    kinds, sources, kalibr = inspectors().values(), find_sources(topics), find_kalibr_files(path)
    for kind in kinds:
        sources = kind.joined(recording, sources)
    target = target or _beside(kalibr)
    share = READING_SHARE if target else 1.0
    streams, facts = _read(recording, topics, sources, lambda what, done: progress(what, share * done))
    inspection = Inspection(str(path), sources, streams, facts, _choose(facts, sources, kalibr), target, kalibr)
    for kind in kinds:
        inspection = kind.searched(
            recording, inspection, lambda what, done: progress(what, share + (1.0 - share) * done)
        )
    notes = tuple(dict.fromkeys(recording.notes() + inspection.notes)) + kalibr.notes
    inspection = dataclasses.replace(inspection, notes=notes)
    return dataclasses.replace(inspection, findings=findings(inspection))


def _beside(kalibr: KalibrFiles) -> GivenTarget | None:
    """The target of a Kalibr file beside the recording; None without one."""
    return GivenTarget(kalibr.target, kalibr.target_file) if kalibr.target else None


def _read(
    recording: Recording, topics: tuple[TopicInfo, ...], sources: Sources, progress: Progress
) -> tuple[tuple[StreamFacts, ...], dict[str, Any]]:
    """Facts by topic, and facts of the kind by name of the sensor. Topics that their sensor does not read in full are
    read for their stamps."""
    read: dict[TopicInfo, StreamFacts] = {}
    facts: dict[str, Any] = {}
    for k, (name, source) in enumerate(sources.sensors.items()):
        progress(f"reading {source.topic.name}", k / len(topics))
        reading = inspectors()[source.kind].read(recording, name, source)
        facts[name] = reading.facts
        if reading.stream is not None:
            read[reading.stream.topic] = reading.stream
    for k, topic in enumerate([t for t in topics if t not in read], len(read)):
        progress(f"reading {topic.name}", k / len(topics))
        read[topic] = _read_stamps(recording, topic, topic.name in sources.left_out)
    clocks = {topic: clock_rate_of(recording.received(topic)) for topic in topics}
    return tuple(dataclasses.replace(read[topic], clock_rate=clocks[topic]) for topic in topics), facts


def _read_stamps(recording: Recording, topic: TopicInfo, left_out: bool) -> StreamFacts:
    """Facts on a topic from its stamps. Timing is None for topics that icalib does not read, CameraInfo, transforms and
    images that are left out."""
    kinds_without_timing = (
        "",
        "camera info",
        *(kind for inspector in inspectors().values() for kind in inspector.frame_topics),
    )
    if left_out or not topic.count or topic.kind in kinds_without_timing:
        return StreamFacts(topic, None)
    try:
        return StreamFacts(topic, timing_of(recording.stamps(topic.name)))
    except RecordingError as error:
        return StreamFacts(topic, None, str(error))


def _choose(facts: dict[str, Any], sources: Sources, kalibr: KalibrFiles) -> str | None:
    """Name of the IMU to calibrate with. An IMU without a problem is preferred, then one in Kalibr's file, then the
    first. None without a readable one."""
    kinds, in_file = inspectors(), {k.topic.strip("/") for k in kalibr.imus}
    readable = {n: s.topic.name for n, s in sources.sensors.items() if kinds[s.kind].sensor.is_inertial and facts[n]}
    order = sorted(readable, key=lambda n: (bool(facts[n].problem), readable[n].strip("/") not in in_file))
    return order[0] if order else None


_UNNAMEABLE = re.compile(r"[^A-Za-z0-9_-]+")


def find_sources(topics: Sequence[TopicInfo]) -> Sources:
    """The sensors among the topics with messages, each under a unique name derived from its topic."""
    filled = [t for t in topics if t.count]
    kinds = sorted(inspectors().values(), key=lambda kind: not kind.named_first)
    keyed = [(key, source, kind.prefix) for kind in kinds for key, source in kind.sources(filled)]
    names = _names([(key, prefix) for key, _, prefix in keyed])
    return Sources({name: source for name, (_, source, _) in zip(names, keyed, strict=True)})


def _names(sensors: list[tuple[Key, str]]) -> list[str]:
    """Unique names from the last parts of the sensors' keys, as few as make the names differ. Keys may be empty."""
    names: list[str] = []
    for length in range(1, max([1, *(len(key) for key, _ in sensors)]) + 1):
        names = [_name(key[-length:], kind) for key, kind in sensors]
        if len(set(names)) == len(names):
            return names
    return [f"{name}_{k}" if name in names[:k] else name for k, name in enumerate(names)]


def _name(parts: Key, kind: str) -> str:
    name = _UNNAMEABLE.sub("_", "_".join(parts)).strip("_-")
    if not name:
        return f"{kind}0"
    return name if name[0].isalpha() else f"{kind}_{name}"


def read_target(path: Path) -> GivenTarget:
    """The target in `path`. Raises RigError, one sentence naming file, line and field."""
    if not path.exists():
        raise RigError(f"{path} does not exist; check the path of the target.")
    root = read_yaml(path)
    fields = root.entries()
    if "target_type" in yaml_mapping(path):
        return GivenTarget(kalibr_target(yaml_mapping(path), str(path)), str(path))
    if "sensors" in fields:
        rig = load_rig(path)
        return GivenTarget(rig.target, str(path), rig.sensors)
    return GivenTarget(load_target(path), str(path))


# A first rig file for a recording: known values with their source, and empty fields for the user to fill in.

_TEMPLATE = """\
# FILL IN the target: count, and measure the print itself with a ruler or a caliper, over as many tags or squares as you
# can and divided by their number. Printers scale, and an error of 1 % in the target is one of 1 % in every translation.
target:
  type: aprilgrid
  rows:         # tags in a column
  cols:         # tags in a row
  tag_size:     # edge of the black square of a tag, m: 0.088 is 88 mm
  tag_spacing:  # gap between tags over tag_size
# Other targets, in place of the lines above:
#   target: {type: charuco, squares_x: , squares_y: , square_size: , marker_size: , dictionary: 5x5_100}
#   target: {type: checkerboard, rows: , cols: , square_size: }  # rows and cols of INNER corners
#   target: {type: markers, family: tag36h11, size: , ids: []}  # free tags, each stuck anywhere
#   none: with an IMU, write `tracks: images` in every camera, and delete `target`; points of the scene are tracked
# Several at once: targets: {NAME: {type: ...}, NAME: {type: ...}}
"""


def draft_rig(inspection: Inspection) -> str:
    """The text of a rig file. Raises RecordingError if the sensors do not determine the motion: there is no camera, no
    sensor such as a LiDAR beside an IMU, and no sensor that gives the motion without an IMU beside another one."""
    broken = {name: problem for name in independent(inspection) if (problem := problem_of(inspection, name))}
    moved = moving(inspection) or inspection.moving_frames
    usable = len(broken) < len(independent(inspection))
    alone = moves_without_imu(inspection) or moves_on_floor(inspection)
    if not (usable or (inertial(inspection) and moved) or alone):
        raise RecordingError(
            f"{inspection.recording} holds no camera that can be read, no {nouns()} beside an IMU, and no "
            f"{nouns(alone=True)} beside other sensors, so there is no rig to draft; record one, too."
        )
    lines = [
        f"# Draft by icalib inspect from {json.dumps(inspection.recording)}. Check every line (docs/rig-file.md).",
        "# Start values ({guess: ...}) have no weight; delete such a line to estimate the value from scratch.",
        "sensors:",
        *_without_imu(inspection),
    ]
    # Topics that need not be sensors on the robot are comments, unless no other sensor gives the motion.
    certain = set(moving(inspection)) & set(named(inspection, lambda kind: kind.is_certain))
    active = not (usable or (inertial(inspection) and certain))
    drafts = [kind.draft(inspection, active) for kind in inspectors().values()]
    lines += (line for draft in drafts for line in draft.lines)
    left_out = {**broken, **inspection.sources.left_out}
    lines += [f"  # Not used: {comment(topic)} ({comment(why)})" for topic, why in left_out.items()]
    return "\n".join([*lines, _target(inspection) if any(draft.needs_target for draft in drafts) else ""])


def _without_imu(inspection: Inspection) -> Iterator[str]:
    """A comment if there is no IMU."""
    if not inertial(inspection):
        alone = "cameras are calibrated alone, the first one's" if independent(inspection) else "the first sensor's"
        yield f"  # No IMU: {alone} frame is the body frame."


def _target(inspection: Inspection) -> str:
    if inspection.target is None:
        return _TEMPLATE
    target = inspection.target.target
    if isinstance(target, Scene):
        lines = ["targets:", *(f"  {name}: {_fields(fields)}" for name, fields in target.plain().items())]
    else:
        lines = [f"target: {_fields(target.plain())}"]
    head = f"# The target is from {comment(inspection.target.file)}; check its sizes with a ruler."
    return "\n".join([head, *lines, ""])


def _fields(plain: dict[str, Any]) -> str:
    return f"{{{', '.join(f'{k}: {number(v) if isinstance(v, float) else v}' for k, v in plain.items())}}}"
