"""A first rig file for a recording: what is known is filled in and says where it is from, the rest is left to fill."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from icalib.base.staging import staged
from icalib.base.text_files import write_text
from icalib.data.recordings import TopicInfo
from icalib.errors import CalibrationError, RecordingError
from icalib.geometry.cameras import CAMERA_MODELS
from icalib.geometry.targets import Scene
from icalib.rig import TwoSources
from icalib.sensors.imu.spec import DEFAULT_CLASS, IMU_CLASSES
from icalib.tools.inspection.facts import CameraSource, Inspection
from icalib.tools.inspection.frames import frame_lines
from icalib.tools.inspection.inspect import resolution_of
from icalib.tools.inspection.kalibr import KalibrImu
from icalib.tools.inspection.lens import LensStart, lens_start
from icalib.tools.inspection.lidar import timing_lines

_PLAIN = re.compile(r"[A-Za-z0-9_./][A-Za-z0-9_./-]*")
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


def draft_rig(found: Inspection) -> str:
    """The text of a rig file. Raises RecordingError where the sensors do not show the motion: no camera, no LiDAR or
    poses beside an IMU, and no poses beside wheels or other poses."""
    broken = {c.name: problem for c in found.sources.cameras if (problem := found.stream(c.topic).problem)}
    cameras = [c for c in found.sources.cameras if c.name not in broken]
    sources = found.sources
    beside_imu = sources.imus and (sources.lidars or sources.poses or found.moving_frames)
    beside_poses = sources.poses and len(sources.poses) + len(sources.wheels) > 1
    if not (cameras or beside_imu or beside_poses):
        raise RecordingError(
            f"{found.recording} holds no camera that can be read, no LiDAR or poses beside an IMU, and no poses beside "
            "wheels, so there is no rig to draft; record one, too."
        )
    lines = [
        f"# Draft by icalib inspect from {json.dumps(found.recording)}. Check every line (docs/rig-file.md).",
        "# Start values ({guess: ...}) have no weight; delete such a line to estimate the value from scratch.",
        "sensors:",
        *_imu(found),
    ]
    for camera in cameras:
        lines += _camera(found, camera)
    lines += _robot(found, shown=not (cameras or (sources.imus and sources.lidars)))
    left_out = {**broken, **found.sources.left_out}
    lines += [f"  # Not used: {_comment(topic)} ({_comment(why)})" for topic, why in left_out.items()]
    blind = any(c.tracks is None and not (found.without_target and c.images) for c in cameras)
    aimed = found.target is not None or blind
    return "\n".join([*lines, _target(found) if cameras and aimed else ""])


def check_draft(path: Path) -> None:
    """Raises CalibrationError where there is something at `path` already."""
    if os.path.lexists(path):
        raise CalibrationError(
            f"{path} exists and was not changed; give another name for the draft, or give it as --target to "
            "use the target in it."
        )


def write_draft(text: str, path: Path) -> None:
    """Writes `text` to `path`, wholly or not at all, and never over another file. Raises CalibrationError."""
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
    """Gives `part` the name `path`; unlike a rename, this fails where the name is taken."""
    try:
        os.link(part, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        with path.open("x", encoding="utf-8") as file:
            file.write(text)


def _imu(found: Inspection) -> list[str]:
    if not found.sources.imus:
        alone = "cameras are calibrated alone, the first one's" if found.sources.cameras else "the first sensor's"
        return [f"  # No IMU: {alone} frame is the body frame."]
    name = found.imu or next(iter(found.sources.imus))
    topic = found.sources.imus[name]
    facts = found.imus.get(name)
    frame, halves = facts.frame if facts else "", found.sources.halves.get(name)
    place = _place(topic.name, topic.type, frame) if halves is None else _places(halves, topic.type, frame)
    lines = [f"  {name}:", "    type: imu", place]
    kalibr = _kalibr_imu(found, topic.name)
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
        values = ", ".join(f"{k}: {_number(v)}" for k, v in noise.items() if k != "source")
        lines.append(
            f"    noise: {{{values}, source: {json.dumps(kalibr.noise.source)}}}  # from {_comment(kalibr.file)}"
        )
    others = [f"{n} ({t.name})" for n, t in found.sources.imus.items() if n != name]
    if others:
        lines.append(f"  # Also recorded: {_comment(', '.join(others))}; a rig has one IMU, choose the best.")
    return lines


def _robot(found: Inspection, shown: bool) -> Iterable[str]:
    """LiDARs, which need an IMU, wheels and poses. The latter are comments unless they are `shown`, because nothing
    else shows the motion: joints may be an arm's, poses what came of these very sensors."""
    for name, topic in found.sources.lidars.items() if found.sources.imus else ():
        yield from (f"  {name}:", "    type: lidar", _place(topic.name, topic.type, ""))
        yield from timing_lines(found.lidars.get(name))
    mark = "" if shown else "# "
    for name, topic in found.sources.wheels.items():
        if not shown:
            yield "  # Are these wheels? Then remove the #, and give what they measure (docs/rig-file.md#wheels)."
        lines = [f"{name}:", "  type: wheels", _place(topic.name, topic.type, "")[2:]]
        for line in lines + (["  measures: twist"] if topic.kind == "twist" or "twist" in topic.type else []):
            yield f"  {mark}{line}"
    for name, topic in found.sources.poses.items():
        if not shown:
            yield "  # Poses of something on the robot, and not computed from the sensors above? Then remove the #;"
            yield "  # absolute is motion capture, relative an odometry, which drifts (docs/rig-file.md#pose-sensor)."
        # Without an IMU the first pose sensor shows the motion, which must not drift.
        kind = _kind(topic) if found.sources.imus else "absolute"
        for line in (f"{name}:", "  type: pose", _place(topic.name, topic.type, "")[2:], f"  kind: {kind}"):
            yield f"  {mark}{line}"
    yield from frame_lines(found.frames, shown and not found.sources.poses)


def _kind(topic: TopicInfo) -> str:
    return "relative" if topic.kind == "odometry" or "odom" in topic.name else "absolute"


def _kalibr_imu(found: Inspection, topic: str) -> KalibrImu | None:
    """The entry with the IMU's topic; else the only one, where it names no topic of this recording."""
    entries = found.kalibr.imus
    topics = {s.topic.name.strip("/") for s in found.streams}
    mine = [k for k in entries if k.topic.strip("/") == topic.strip("/")]
    if not mine and len(entries) == 1 and entries[0].topic.strip("/") not in topics:
        mine = list(entries)
    return mine[0] if mine else None


def _camera(found: Inspection, camera: CameraSource) -> list[str]:
    resolution = resolution_of(found, camera)
    lens = lens_start(found, camera, resolution)
    frame = found.images[camera.name].frame if camera.images else ""
    lines = [f"  {camera.name}:", "    type: camera"]
    if camera.corners:
        lines.append(_place(camera.corners.name, camera.corners.type, ""))
    if camera.images:
        lines.append(_place(camera.images.name, camera.images.type if camera.corners is None else "images", frame))
    if camera.tracks:
        lines.append(f"    tracks: {_name(camera.tracks.name)}  # {_comment(camera.tracks.type)}")
    elif found.without_target and camera.images:
        lines.append("    tracks: images  # points of the scene; a few images show no tags and no checkerboard")
    lines.append(f"    model: {lens.model}  # {_comment(lens.why)}")
    lines.append(
        f"    resolution: [{resolution[0]}, {resolution[1]}]"
        if resolution
        else "    resolution:  # FILL IN: [width, height] of the images, px"
    )
    lines += _starts(lens)
    lines += [f"    # {_comment(note)}" for note in lens.notes]
    return lines


def _starts(lens: LensStart) -> Iterable[str]:
    if lens.intrinsics is not None:
        yield f"    intrinsics: {{guess: {_numbers(lens.intrinsics)}}}  # fx, fy, cx, cy from {_comment(lens.source)}"
    if lens.distortion is not None:
        names = ", ".join(CAMERA_MODELS[lens.model].parameter_names[4:])
        yield f"    distortion: {{guess: {_numbers(lens.distortion)}}}  # {names} from {_comment(lens.source)}"


def _place(name: str, kind: str, frame: str) -> str:
    """`topic` of a bag or a folder of images; `path` of a table."""
    field = "path" if name.endswith((".csv", ".csv.gz", ".npz", ".tum", ".txt")) else "topic"
    return f"    {field}: {_name(name)}  # {_comment(kind)}" + _in_frame(frame)


def _places(halves: TwoSources, kind: str, frame: str) -> str:
    """`topic` of an IMU on two of them."""
    shown = f"{{gyro: {_name(halves.gyro)}, accel: {_name(halves.accel)}}}"
    return f"    topic: {shown}  # {_comment(kind)}" + _in_frame(frame)


def _name(name: str) -> str:
    return name if _PLAIN.fullmatch(name) else json.dumps(name)


def _in_frame(frame: str) -> str:
    return f", frame {json.dumps(frame)}" if frame else ""


def _target(found: Inspection) -> str:
    if found.target is None:
        return _TEMPLATE
    target = found.target.target
    if isinstance(target, Scene):
        lines = ["targets:", *(f"  {name}: {_fields(fields)}" for name, fields in target.plain().items())]
    else:
        lines = [f"target: {_fields(target.plain())}"]
    head = f"# The target is from {_comment(found.target.file)}; check its sizes with a ruler."
    return "\n".join([head, *lines, ""])


def _fields(plain: dict[str, Any]) -> str:
    return f"{{{', '.join(f'{k}: {_number(v) if isinstance(v, float) else v}' for k, v in plain.items())}}}"


def _numbers(values: Iterable[float]) -> str:
    return f"[{', '.join(map(_number, values))}]"


def _number(value: float) -> str:
    return repr(float(value))


def _comment(text: str) -> str:
    """`text` on one line."""
    return " ".join(text.split())
