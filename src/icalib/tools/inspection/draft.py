"""A first rig file for a recording: known values with their source, and empty fields for the user to fill in."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from icalib.base.staging import staged
from icalib.base.text_files import write_text
from icalib.errors import CalibrationError, RecordingError
from icalib.geometry.cameras import CAMERA_MODELS
from icalib.geometry.targets import Scene
from icalib.rig import TwoSources
from icalib.sensors.imu.spec import DEFAULT_CLASS, IMU_CLASSES
from icalib.tools.inspection.facts import CameraSource, Inspection
from icalib.tools.inspection.inspect import resolution_of
from icalib.tools.inspection.kalibr import KalibrImu
from icalib.tools.inspection.kinds import inspectors, moves_without_imu, moving, nouns
from icalib.tools.inspection.lens import LensStart, lens_start
from icalib.tools.inspection.rig_lines import comment, in_frame, name_text, number, numbers, place_line

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
    broken = {c.name: problem for c in inspection.sources.cameras if (problem := inspection.stream(c.topic).problem)}
    cameras = [c for c in inspection.sources.cameras if c.name not in broken]
    moved = moving(inspection) or inspection.moving_frames
    if not (cameras or (inspection.sources.imus and moved) or moves_without_imu(inspection)):
        raise RecordingError(
            f"{inspection.recording} holds no camera that can be read, no {nouns()} beside an IMU, and no "
            f"{nouns(alone=True)} beside other sensors, so there is no rig to draft; record one, too."
        )
    lines = [
        f"# Draft by icalib inspect from {json.dumps(inspection.recording)}. Check every line (docs/rig-file.md).",
        "# Start values ({guess: ...}) have no weight; delete such a line to estimate the value from scratch.",
        "sensors:",
        *_imu(inspection),
    ]
    for camera in cameras:
        lines += _camera(inspection, camera)
    lines += _others(inspection, bool(cameras))
    left_out = {**broken, **inspection.sources.left_out}
    lines += [f"  # Not used: {comment(topic)} ({comment(why)})" for topic, why in left_out.items()]
    needs_target = any(c.tracks is None and not (inspection.without_target and c.images) for c in cameras)
    writes_target = inspection.target is not None or needs_target
    return "\n".join([*lines, _target(inspection) if cameras and writes_target else ""])


def check_draft(path: Path) -> None:
    """Raises CalibrationError if `path` exists."""
    if os.path.lexists(path):
        raise CalibrationError(
            f"{path} exists and was not changed; give another name for the draft, or give it as --target to "
            "use the target in it."
        )


def write_draft(text: str, path: Path) -> None:
    """Writes `text` to `path` atomically. Raises CalibrationError if `path` exists or cannot be written."""
    try:
        with staged(path.parent) as place:
            part = place / path.name
            write_text(part, text)
            _link(part, path, text)
    except FileExistsError:
        check_draft(path)
        raise CalibrationError(f"{path} exists; give another name for the draft.") from None
    except OSError as error:
        raise CalibrationError(
            f"{path} cannot be written ({error.strerror or error}); choose another place."
        ) from error


def _link(part: Path, path: Path, text: str) -> None:
    """Gives the file `part` the name `path`. Unlike a rename, this raises FileExistsError if `path` exists."""
    try:
        os.link(part, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        with path.open("x", encoding="utf-8") as file:
            file.write(text)


def _imu(inspection: Inspection) -> list[str]:
    if not inspection.sources.imus:
        alone = "cameras are calibrated alone, the first one's" if inspection.sources.cameras else "the first sensor's"
        return [f"  # No IMU: {alone} frame is the body frame."]
    name = inspection.imu or next(iter(inspection.sources.imus))
    topic = inspection.sources.imus[name]
    facts = inspection.imus.get(name)
    frame, halves = facts.frame if facts else "", inspection.sources.halves.get(name)
    place = "    " + place_line(topic.name, topic.type, frame) if halves is None else _places(halves, topic.type, frame)
    lines = [f"  {name}:", "    type: imu", place]
    kalibr = _kalibr_imu(inspection, topic.name)
    if kalibr is None:
        classes = ", ".join(IMU_CLASSES)
        lines += [
            f"    # The default class of {classes}. Better: the densities of the data sheet or of an Allan variance,",
            "    # {gyro: , gyro_walk: , accel: , accel_walk: }, in rad/s/sqrt(Hz), rad/s^2/sqrt(Hz), m/s^2/sqrt(Hz),",
            "    # m/s^3/sqrt(Hz).",
            f"    noise: {DEFAULT_CLASS}",
        ]
    else:
        noise = dataclasses.asdict(kalibr.noise)
        values = ", ".join(f"{k}: {number(v)}" for k, v in noise.items() if k != "source")
        lines.append(
            f"    noise: {{{values}, source: {json.dumps(kalibr.noise.source)}}}  # from {comment(kalibr.file)}"
        )
    others = [f"{n} ({t.name})" for n, t in inspection.sources.imus.items() if n != name]
    if others:
        lines.append(f"  # Also recorded: {comment(', '.join(others))}; a rig has one IMU, choose the best.")
    return lines


def _others(inspection: Inspection, has_cameras: bool) -> Iterator[str]:
    """Lines of sensors that are neither IMU nor camera. Topics that need not be sensors on the robot are comments,
    unless no other sensor gives the motion."""
    kinds, imus = inspectors(), inspection.sources.imus
    certain_sensors = [n for n in moving(inspection) if kinds[inspection.sources.others[n].kind].is_certain]
    default_active = not (has_cameras or (imus and certain_sensors))
    for kind, inspector in kinds.items():
        for name, topic in inspection.sources.of(kind).items():
            if inspector.sensor.needs_imu and not imus:
                continue
            is_active = default_active or inspector.is_certain
            yield from (f"  # {line}" for line in inspector.doubt if not is_active)
            fields = (f"type: {kind}", place_line(topic.name, topic.type), *inspector.lines(inspection, name, topic))
            for line in (f"{name}:", *(f"  {field}" for field in fields)):
                yield f"  {'' if is_active else '# '}{line}"
        yield from (f"  {line}" for line in inspector.more_lines(inspection, default_active))


def _kalibr_imu(inspection: Inspection, topic: str) -> KalibrImu | None:
    """Kalibr's entry for the IMU's topic; else its only entry, if that names no topic of this recording."""
    entries = inspection.kalibr.imus
    topics = {s.topic.name.strip("/") for s in inspection.streams}
    matches = [k for k in entries if k.topic.strip("/") == topic.strip("/")]
    if not matches and len(entries) == 1 and entries[0].topic.strip("/") not in topics:
        matches = list(entries)
    return matches[0] if matches else None


def _camera(inspection: Inspection, camera: CameraSource) -> list[str]:
    resolution = resolution_of(inspection, camera)
    lens = lens_start(inspection, camera, resolution)
    frame = inspection.images[camera.name].frame if camera.images else ""
    lines = [f"  {camera.name}:", "    type: camera"]
    if camera.corners:
        lines.append(f"    {place_line(camera.corners.name, camera.corners.type)}")
    if camera.images:
        kind = camera.images.type if camera.corners is None else "images"
        lines.append(f"    {place_line(camera.images.name, kind, frame)}")
    if camera.tracks:
        lines.append(f"    tracks: {name_text(camera.tracks.name)}  # {comment(camera.tracks.type)}")
    elif inspection.without_target and camera.images:
        lines.append("    tracks: images  # points of the scene; a few images show no tags and no checkerboard")
    lines.append(f"    model: {lens.model}  # {comment(lens.why)}")
    lines.append(
        f"    resolution: [{resolution[0]}, {resolution[1]}]"
        if resolution
        else "    resolution:  # FILL IN: [width, height] of the images, px"
    )
    lines += _starts(lens)
    lines += [f"    # {comment(note)}" for note in lens.notes]
    return lines


def _starts(lens: LensStart) -> Iterable[str]:
    if lens.intrinsics is not None:
        yield f"    intrinsics: {{guess: {numbers(lens.intrinsics)}}}  # fx, fy, cx, cy from {comment(lens.source)}"
    if lens.distortion is not None:
        names = ", ".join(CAMERA_MODELS[lens.model].parameter_names[4:])
        yield f"    distortion: {{guess: {numbers(lens.distortion)}}}  # {names} from {comment(lens.source)}"


def _places(halves: TwoSources, kind: str, frame: str) -> str:
    """The `topic` line of an IMU whose gyroscope and accelerometer have a topic each."""
    topics = f"{{gyro: {name_text(halves.gyro)}, accel: {name_text(halves.accel)}}}"
    return f"    topic: {topics}  # {comment(kind)}" + in_frame(frame)


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
