"""Export to ROS 2: static transforms and CameraInfo files, and joints of a URDF."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from icalib.base.files import regular
from icalib.base.yaml_nodes import LARGEST
from icalib.errors import CalibrationError
from icalib.export.common import (
    CameraParameters,
    Export,
    guessed_poses,
    imu_parameters,
    imus,
    inverse,
    lens_of,
    moving_offsets,
    need,
    no_place_for,
    others,
    quaternion,
    sensor_intrinsics,
    time_offsets,
    yaml_text,
)
from icalib.geometry.so3 import rpy
from icalib.result import Calibration
from icalib.sensors.fields import rotation_of_rpy

# Export to ROS 2: a launch file of static transforms, and CameraInfo files for camera_info_manager.
#
# Export to Autoware: `sensor_kit_calibration.yaml`, and `sensors_calibration.yaml` if wheels define base_link.

_DISTORTION = {
    "pinhole-radtan": "plumb_bob",
    "pinhole-radtan5": "plumb_bob",
    "pinhole-rational": "rational_polynomial",
    "pinhole-equidistant": "equidistant",
}
_LAUNCH = """\
{comments}
from launch import LaunchDescription
from launch_ros.actions import Node

# child frame: (parent frame, x, y, z [m], quaternion x, y, z, w)
TRANSFORMS = {{
{rows}
}}


def generate_launch_description():
    return LaunchDescription(
        [
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                name="static_tf_{{}}".format(child.replace("/", "_").replace("-", "_")),
                arguments=[
                    "--x", x, "--y", y, "--z", z, "--qx", qx, "--qy", qy, "--qz", qz, "--qw", qw,
                    "--frame-id", parent, "--child-frame-id", child,
                ],
            )
            for child, (parent, x, y, z, qx, qy, qz, qw) in TRANSFORMS.items()
        ]
    )
"""


def ros2_static(c: Calibration, frames: Mapping[str, str]) -> Export:
    """The file static_transforms.launch.py. frames: frame name by sensor, for sensors whose frame has another name."""
    offsets, lenses = time_offsets(c, c.mounted), [f"the lens of {name}" for name in c.cameras]
    omissions = [*offsets, *lenses, *sensor_intrinsics(c), *imu_parameters(c, imus(c))]
    sentences = no_place_for("tf", omissions) + guessed_poses(c)
    parent = frames.get(c.body, c.body)
    comments = [
        "Static transforms for ROS 2, by icalib.",
        f"Each is the pose of the child frame in its parent's: p_parent = T p_child, the parent being {parent}.",
        "Frames of cameras are optical frames: x right, y down, z forward.",
        *sentences,
    ]
    rows = []
    for name in c.on_body:
        T = c.T_body_sensor(name)
        values = [repr(float(v)) for v in (*T[:3, 3], *quaternion(T[:3, :3]))]
        rows.append(f"    {frames.get(name, name)!r}: {(parent, *values)!r},")
    text = _LAUNCH.format(comments="\n".join(f"# {line}" for line in comments), rows="\n".join(rows))
    return Export({"static_transforms.launch.py": text}, sentences)


def camera_info(c: Calibration) -> Export:
    """CameraInfo: one file for each camera. Raises CalibrationError without a camera."""
    need(c.cameras, "camera", "CameraInfo")
    lenses = {name: lens_of(c, name, "CameraInfo", tuple(_DISTORTION)) for name in c.cameras}
    sentences = tuple(lens.sentence for lens in lenses.values() if lens.sentence)
    omissions = ["poses", *time_offsets(c, c.mounted), *others(c, *c.cameras), *imu_parameters(c, imus(c)[:1])]
    sentences += no_place_for("CameraInfo", omissions) + moving_offsets(c, c.cameras)
    return Export({f"{name}.yaml": _info(name, lens, sentences) for name, lens in lenses.items()}, sentences)


def _info(name: str, lens: CameraParameters, sentences: tuple[str, ...]) -> str:
    fx, fy, cx, cy = lens.intrinsics
    D = lens.distortion + ([0.0] if lens.model == "pinhole-radtan" else [])
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    width, height = lens.resolution
    data = {
        "image_width": width,
        "image_height": height,
        "camera_name": name,
        "camera_matrix": _matrix(K),
        "distortion_model": _DISTORTION[lens.model],
        "distortion_coefficients": _matrix(np.array([D])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.hstack([K, np.zeros((3, 1))])),
    }
    comments = [
        f"CameraInfo of {name}, by icalib. It holds the lens and no pose; pixel (0, 0) is the centre of the first one.",
        "Not rectified: rectification_matrix is the identity, and projection_matrix that of the camera itself.",
        *sentences,
    ]
    return yaml_text(comments, data)


def _matrix(values: np.ndarray) -> dict[str, object]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}


KIT = "sensor_kit_base_link"
# R_optical_link: from a camera's link frame (x forward, y left, z up; REP 103) to its optical frame (z forward, x
# right, y down).
_OPTICAL_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def autoware(c: Calibration, frames: Mapping[str, str]) -> Export:
    """Poses of all sensors except wheels in the frame of the sensor kit, which is the body frame. frames: frame name by
    sensor, for sensors whose frame has another name."""
    names = [name for name in (c.body, *c.on_body) if name not in c.wheels]
    omissions = [*sensor_intrinsics(c), *imu_parameters(c, imus(c)), *time_offsets(c, c.mounted), *c.wheels[1:]]
    sentences = no_place_for("Autoware", [*omissions, *(f"the lens of {camera}" for camera in c.cameras)])
    sentences += guessed_poses(c)
    comments = [
        f"For Autoware, by icalib. {KIT} is the frame of {c.body}.",
        "Each entry places a frame on it: p_parent = T p_child, T = Rz(yaw) Ry(pitch) Rx(roll), m and rad.",
        "Frames of cameras are camera_link: x forward, y left, z up. Those of LiDARs are the frames of their points.",
    ]
    kit = {frames.get(name, _frame(c, name)): _entry(_pose(c, name)) for name in names}
    files = {"sensor_kit_calibration.yaml": yaml_text([*comments, *sentences], {KIT: kit})}
    if c.wheels:
        files["sensors_calibration.yaml"] = _vehicle(c, c.wheels[0], sentences)
    return Export(files, sentences)


def _vehicle(c: Calibration, wheels: str, sentences: tuple[str, ...]) -> str:
    """Pose of the sensor kit in base_link, which is on the ground below the unsteered axle, one wheel radius down.
    Without a wheel radius, base_link is at the axle."""
    radius = [g.value.mean() for g in c.groups if g.sensor == wheels and g.name in ("radii", "radius")]
    T = inverse(c.T_body_sensor(wheels))
    T[2, 3] += radius[0] if radius else 0.0
    height = (
        f"one wheel radius below the axle of {wheels}"
        if radius
        else f"at the axle of {wheels}, whose height is not known"
    )
    comments = [
        "For Autoware, by icalib: p_parent = T p_child.",
        f"base_link is {height}; its axes are those of {wheels}.",
    ]
    return yaml_text([*comments, *sentences], {"base_link": {KIT: _entry(T)}})


def _frame(c: Calibration, name: str) -> str:
    """Default frame name of a sensor, by its type."""
    return f"{name}/camera_link" if name in c.cameras else f"{name}_link" if name == c.imu else f"{name}_base_link"


def _pose(c: Calibration, name: str) -> np.ndarray:
    """4x4 T_body_sensor; for a camera the pose of its link frame instead of the optical frame."""
    T = np.array(c.T_body_sensor(name))
    if name in c.cameras:
        T[:3, :3] = T[:3, :3] @ _OPTICAL_BODY
    return T


def _entry(T: np.ndarray) -> dict[str, float]:
    values = np.concatenate([T[:3, 3], rpy(T[:3, :3])])
    return dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), values.tolist(), strict=True))


# Export to URDF: a new robot of the sensors, or an existing file in which origins of joints are replaced.
#
# Reads the joints of a URDF or xacro file: parent, child, origin, and the byte positions of the origin in the file.

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
    omissions += sensor_intrinsics(c) + imu_parameters(c, imus(c))
    return no_place_for("URDF", omissions) + guessed_poses(c)


def _text(values: object) -> str:
    return " ".join(repr(0.0 if abs(v) < _TOO_DEEP else float(v)) for v in np.asarray(values, dtype=np.float64))


_ATTRIBUTES = ("xyz", "rpy")


@dataclass
class Joint:
    """One joint. xyz [m], rpy [rad]: text of the origin's attributes as in the file. in_macro: whether it is in a xacro
    macro.

    start_end: byte offset just after the joint's start tag. origin: byte offsets of the begin and the end of the
    origin's start tag, None without an origin.
    """

    name: str
    type: str
    in_macro: bool
    start_end: int
    parent: str = ""
    child: str = ""
    xyz: str = "0 0 0"
    rpy: str = "0 0 0"
    origin: tuple[int, int] | None = None


@dataclass(frozen=True)
class UrdfTree:
    """Links and joints of the URDF file `path`. content: bytes of the file; links: names of all links."""

    path: str
    content: bytes
    links: tuple[str, ...]
    joints: tuple[Joint, ...] = field(default=())

    def fail(self, sentence: str) -> CalibrationError:
        """An error to raise, with the file name before `sentence`."""
        return CalibrationError(f"{self.path}: {sentence}")

    def above(self, link: str) -> Joint | None:
        """The joint whose child is `link`; None for a root. Raises CalibrationError if there are several."""
        parents = [j for j in self.joints if j.child == link]
        if len(parents) > 1:
            raise self.fail(
                f"{link} is the child of {' and '.join(j.name for j in parents)}; a link has one joint above."
            )
        return parents[0] if parents else None

    def check_link(self, link: str, sensor: str) -> None:
        """Raise CalibrationError if there is no such link. sensor: its name, for the message."""
        if link not in self.links:
            named = ", ".join(self.links[:20]) + (", ..." if len(self.links) > 20 else "")
            raise self.fail(f"there is no link {link}; it has {named}; say which is {sensor}: --frame {sensor}=LINK.")

    def chain(self, link: str) -> list[Joint]:
        """Joints from `link` up to the root. Raises CalibrationError if they form a cycle."""
        joints: list[Joint] = []
        joint = self.above(link)
        while joint is not None:
            if joint in joints:
                raise self.fail(f"joint {joint.name} is above itself; correct the parents.")
            joints.append(joint)
            joint = self.above(joint.parent)
        return joints

    def T(self, frame: str, link: str) -> np.ndarray:
        """4x4 pose of `link` in the frame of the link `frame`: p_frame = T p_link. Raises CalibrationError if they are
        in different trees, if a joint between them is not fixed, or if its origin is not plain numbers."""
        one, other = self.chain(frame), self.chain(link)
        roots = {(c[-1].parent if c else name) for c, name in ((one, frame), (other, link))}
        if len(roots) > 1:
            raise self.fail(f"{frame} and {link} are not joined; their roots are {' and '.join(sorted(roots))}.")
        shared = [j for j in one if j in other]
        up, down = (self._product([j for j in c if j not in shared]) for c in (one, other))
        return np.linalg.inv(up) @ down

    def is_fixed(self, frame: str, link: str) -> bool:
        """Whether both links are in one tree with only fixed joints between them."""
        one, other = self.chain(frame), self.chain(link)
        joined = (one[-1].parent if one else frame) == (other[-1].parent if other else link)
        return joined and all(j.type == "fixed" for j in [*one, *other] if not (j in one and j in other))

    def _product(self, upwards: list[Joint]) -> np.ndarray:
        """4x4 product of the origins of joints that are listed from child to root. Raises CalibrationError if one is
        not fixed."""
        T = np.eye(4)
        for joint in upwards:
            if joint.type != "fixed":
                raise self.fail(f"joint {joint.name} is {joint.type}, not fixed, so what is below it has no one pose.")
            T = self.origin(joint) @ T
        return T

    def origin(self, joint: Joint) -> np.ndarray:
        """4x4 T_parent_child of a joint. Raises CalibrationError if the origin is not plain numbers."""
        x, y, z = self._numbers(joint, "xyz")
        T = np.eye(4)
        T[:3, :3] = rotation_of_rpy(*self._numbers(joint, "rpy"))
        T[:3, 3] = x, y, z
        return T

    def _numbers(self, joint: Joint, name: str) -> list[float]:
        text = getattr(joint, name)
        try:
            values = [float(part) for part in text.split()]
        except ValueError:
            values = []
        if len(values) != 3 or not (np.abs(values) < LARGEST).all():
            raise self.fail(
                f'joint {joint.name}: {name}="{text}" is not three plain numbers; expand the file first '
                "(xacro robot.xacro > robot.urdf)."
            )
        return values


def read_urdf(path: Path) -> UrdfTree:
    """Parse the file `path`. Raises CalibrationError if it cannot be read, is not XML, or has no robot element."""
    try:
        content = regular(path).read_bytes()
    except OSError as error:
        raise CalibrationError(f"{path} cannot be read ({error.strerror or error}); give a URDF file.") from error
    reader = _Reader(content)
    try:
        reader.parser.Parse(content, True)
    except expat.ExpatError as error:
        raise CalibrationError(f"{path}:{error.lineno}: this is not XML ({error}); correct it.") from error
    if reader.root != "robot":
        raise CalibrationError(f"{path} has <{reader.root}> where a URDF has <robot>; give a URDF or xacro file.")
    return UrdfTree(str(path), content, tuple(reader.links), tuple(reader.joints))


class _Reader:
    """Collects links and joints while expat parses the file."""

    def __init__(self, content: bytes) -> None:
        self.content, self.root = content, ""
        self.links: list[str] = []
        self.joints: list[Joint] = []
        self._open: list[str] = []
        self._joint: Joint | None = None
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler, self.parser.EndElementHandler = self._start, self._end

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self.root = self.root or name
        begin = self.parser.CurrentByteIndex
        above = self._open[-1] if self._open else ""
        self._open.append(name)
        if name == "link" and above != "joint":
            self.links.append(attributes.get("name", ""))
        elif name == "joint" and "type" in attributes and self._joint is None:
            in_macro = "xacro:macro" in self._open
            end = tag_end(self.content, begin)
            self._joint = Joint(attributes.get("name", ""), attributes["type"], in_macro, end)
        elif self._joint is not None and above == "joint":
            self._part(name, attributes, begin)

    def _part(self, name: str, attributes: dict[str, str], begin: int) -> None:
        assert self._joint is not None
        if name in ("parent", "child"):
            setattr(self._joint, name, attributes.get("link", ""))
        elif name == "origin":
            self._joint.origin = begin, tag_end(self.content, begin)
            for key in _ATTRIBUTES:
                setattr(self._joint, key, attributes.get(key, "0 0 0"))

    def _end(self, name: str) -> None:
        self._open.pop()
        if name == "joint" and self._joint is not None:
            self.joints.append(self._joint)
            self._joint = None


def tag_end(content: bytes, begin: int) -> int:
    """Byte offset just after the start tag that begins at `begin`. A `>` inside quotes does not end the tag."""
    match = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""").match(content, begin)
    assert match is not None, "expat has read a tag here"
    return match.end()
