"""A first rig file for a recording: known values with their source, and empty fields for the user to fill in."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from icalib.errors import RecordingError
from icalib.geometry.targets import Scene
from icalib.tools.inspection.facts import Inspection
from icalib.tools.inspection.kinds import (
    comment,
    independent,
    inertial,
    inspectors,
    moves_on_floor,
    moves_without_imu,
    moving,
    named,
    nouns,
    number,
    problem_of,
)

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
    for kind in inspectors().values():
        lines += kind.draft(inspection, active)
    left_out = {**broken, **inspection.sources.left_out}
    lines += [f"  # Not used: {comment(topic)} ({comment(why)})" for topic, why in left_out.items()]
    needs_target = any(kind.needs_target(inspection) for kind in inspectors().values())
    return "\n".join([*lines, _target(inspection) if needs_target else ""])


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
