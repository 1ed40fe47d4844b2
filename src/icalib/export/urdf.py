"""Export to URDF: a new robot of the sensors, or an existing file in which origins of joints are replaced."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from icalib.export.common import (
    Export,
    guessed_poses,
    imu_intrinsics,
    inverse,
    no_place_for,
    sensor_intrinsics,
    time_offsets,
)
from icalib.export.urdf_tree import Joint, UrdfTree, read_urdf
from icalib.geometry.euler import rpy
from icalib.result import Calibration

_TOO_DEEP = 1e-12  # m or rad: smaller values are written as 0


def urdf(c: Calibration, frames: Mapping[str, str]) -> Export:
    """The file sensors.urdf: a link of the body, and one fixed joint to each sensor's link. frames: link name by
    sensor, for sensors whose link has another name."""
    sentences = _omissions(c)
    body = frames.get(c.body, c.body)
    comments = [
        "Sensors by icalib.",
        "The origin of a joint is the pose of its child in its parent: p_parent = T p_child, xyz in m, rpy in rad,",
        "R = Rz(yaw) Ry(pitch) Rx(roll). Links of cameras are optical frames: x right, y down, z forward.",
        *sentences,
    ]
    lines = ['<?xml version="1.0"?>', *(f"<!-- {line.replace('--', '- -')} -->" for line in comments)]
    lines += ['<robot name="sensors">', f"  <link name={quoteattr(body)}/>"]
    for name in c.on_body:
        link, T = frames.get(name, name), c.T_body_sensor(name)
        lines += [
            f"  <link name={quoteattr(link)}/>",
            f'  <joint name={quoteattr(f"{link}_joint")} type="fixed">',
            f"    <parent link={quoteattr(body)}/>",
            f"    <child link={quoteattr(link)}/>",
            f'    <origin xyz="{_text(T[:3, 3])}" rpy="{_text(rpy(T[:3, :3]))}"/>',
            "  </joint>",
        ]
    return Export({"sensors.urdf": "\n".join([*lines, "</robot>"]) + "\n"}, sentences)


def updated_urdf(c: Calibration, path: Path, frames: Mapping[str, str], joints: Mapping[str, str]) -> Export:
    """The file `path` with new origins of joints, so that each sensor's link has its calibrated pose in the body's
    frame.

    The joint directly above each sensor's link is changed, and nothing else. frames: link name by sensor, if they
    differ. joints: joint to change instead, by sensor, further up the tree (such as the camera joint above an optical
    frame). Sensors without a link are omitted, and a sentence says so.

    Raises CalibrationError if a link of the body or of `frames` does not exist, or a joint between body and sensor
    moves. It is also raised if the origin is in a xacro macro or is not plain numbers.
    """
    tree = read_urdf(path)
    body = frames.get(c.body, c.body)
    tree.check_link(body, c.body)
    sensors = c.on_body
    for name in sensors:
        if name in frames:
            tree.check_link(frames[name], name)
    links = {name: frames.get(name, name) for name in sensors if frames.get(name, name) in tree.links}
    if not links:
        tree.check_link(sensors[0] if sensors else "a sensor", sensors[0] if sensors else "it")
    # From the root downwards, because the new origin of a joint moves all links below it.
    for name in sorted(links, key=lambda sensor: len(tree.chain(links[sensor]))):
        tree = _set(tree, body, links[name], joints.get(name), c.T_body_sensor(name))
    absent = tuple(f"{path.name} has no link {n}, so {n} was left out." for n in sensors if n not in links)
    text = tree.content.decode("utf-8", "surrogateescape")
    return Export({path.name: text}, absent + _omissions(c))


def _set(tree: UrdfTree, body: str, link: str, named: str | None, T_body_link: np.ndarray) -> UrdfTree:
    """The tree with a new origin of the joint directly above `link`, or of the joint `named` above it. T_body_link (4,
    4): the calibrated pose. Raises CalibrationError if that joint cannot be set."""
    chain = tree.chain(link)
    if not chain:
        raise tree.fail(f"{link} is the root, so no joint can be set for it; join it to {body} or below.")
    joint = next((j for j in chain if j.name == named), None) if named else chain[0]
    if joint is None:
        names = ", ".join(j.name for j in chain)
        raise tree.fail(f"there is no joint {named} above {link}; above it are {names}; correct --joint.")
    if joint in tree.chain(body):
        raise tree.fail(f"{body} is below {link}; the sensors' links must not be above that of {body}.")
    if joint.type != "fixed":
        raise tree.fail(f"joint {joint.name} above {link} is {joint.type}; only a fixed joint can hold a calibration.")
    if joint.in_macro:
        raise tree.fail(
            f"joint {joint.name} stands in a xacro macro, where a change would be one for all its uses; expand the "
            "file first (xacro robot.xacro > robot.urdf)."
        )
    origin = inverse(tree.T(body, joint.parent)) @ T_body_link @ inverse(tree.T(joint.child, link))
    return _with_origin(tree, joint, _text(origin[:3, 3]), _text(rpy(origin[:3, :3])))


def _with_origin(tree: UrdfTree, joint: Joint, xyz: str, turn: str) -> UrdfTree:
    """The tree with this origin in `joint`. An origin element is inserted if there is none, and byte offsets of all
    joints are updated."""
    content = tree.content
    if joint.origin is None:
        begin = end = joint.start_end
        gap = re.match(rb"\s*", content[end:])
        indent = gap.group() if gap and b"\n" in gap.group() else b""
        new = indent + f'<origin xyz="{xyz}" rpy="{turn}"/>'.encode()
    else:
        begin, end = joint.origin
        new = _attribute(_attribute(content[begin:end], "rpy", turn), "xyz", xyz)
    shift = len(new) - (end - begin)

    def moved(at: int) -> int:
        return at + shift if at >= end else at

    joints = []
    for other in tree.joints:
        span = other.origin
        moved_span = None if span is None else (moved(span[0]), moved(span[1]))
        now = dataclasses.replace(other, start_end=moved(other.start_end), origin=moved_span)
        if other is joint:
            at = begin + (len(new) - len(new.lstrip()))
            now = dataclasses.replace(other, xyz=xyz, rpy=turn, origin=(at, begin + len(new)))
        joints.append(now)
    return dataclasses.replace(tree, content=content[:begin] + new + content[end:], joints=tuple(joints))


def _attribute(tag: bytes, name: str, value: str) -> bytes:
    """The start tag with the attribute `name` set to `value`; all other bytes are unchanged."""
    match = re.search(rb"""(?<=\s)%s\s*=\s*("[^"]*"|'[^']*')""" % name.encode(), tag)
    if match is None:
        return re.sub(rb"^<origin", f'<origin {name}="{value}"'.encode(), tag)
    begin, end = match.span(1)
    return tag[: begin + 1] + value.encode() + tag[end - 1 :]


def _omissions(c: Calibration) -> tuple[str, ...]:
    """Sentences on calibrated values that URDF cannot represent."""
    omissions = time_offsets(c, c.mounted) + [f"the lens of {name}" for name in c.cameras]
    omissions += sensor_intrinsics(c) + imu_intrinsics(c)
    return no_place_for("URDF", omissions) + guessed_poses(c)


def _text(values: object) -> str:
    return " ".join(repr(0.0 if abs(v) < _TOO_DEEP else float(v)) for v in np.asarray(values, dtype=np.float64))
