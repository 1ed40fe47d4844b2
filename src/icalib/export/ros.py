"""Export to ROS 2: a launch file of static transforms, and CameraInfo files for camera_info_manager.

Export to Autoware: `sensor_kit_calibration.yaml`, and `sensors_calibration.yaml` if wheels define base_link.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icalib.export.common import (
    CameraParameters,
    Export,
    guessed_poses,
    imu_intrinsics,
    inverse,
    lens_of,
    need,
    no_place_for,
    others,
    quaternion,
    sensor_intrinsics,
    time_offsets,
    yaml_text,
)
from icalib.geometry.euler import rpy
from icalib.result import Calibration

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
    omissions = [*offsets, *lenses, *sensor_intrinsics(c), *imu_intrinsics(c)]
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
    omissions = ["poses", *time_offsets(c, c.mounted), *others(c, *c.cameras), *imu_intrinsics(c)]
    sentences += no_place_for("CameraInfo", omissions)
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
    omissions = [*sensor_intrinsics(c), *imu_intrinsics(c), *time_offsets(c, c.mounted), *c.wheels[1:]]
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
