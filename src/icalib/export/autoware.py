"""Export to Autoware: `sensor_kit_calibration.yaml`, and `sensors_calibration.yaml` if wheels define base_link."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icalib.export.common import (
    Export,
    guessed_poses,
    imu_intrinsics,
    inverse,
    no_place_for,
    sensor_intrinsics,
    time_offsets,
    yaml_text,
)
from icalib.geometry.euler import rpy
from icalib.result import Calibration

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
