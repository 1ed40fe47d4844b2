"""Likely mistakes behind a contradicted value of the rig file: an inverse, another frame, another unit."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from icalib.geometry import so3
from icalib.geometry.vectors import is_near
from icalib.rig import Rig
from icalib.sensors import call_kind

NEAR_RAD = 0.15  # rad: largest difference between a rotation in another convention and the estimate
NEARLY = 0.1  # relative difference between a value in another unit and the estimate
TURNS = [  # all rotations by right angles, and reflections
    np.array(axes, dtype=np.float64)[list(order)]
    for order in permutations(range(3))
    for axes in (np.diag(signs) for signs in product((1.0, -1.0), repeat=3))
]
LENGTHS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches"}
IMAGE_SIZES = (2.0, 0.5, 4.0, 0.25)


def looks_like(
    rig: Rig, key: tuple[str, str], value: np.ndarray, estimate: np.ndarray, rotation: np.ndarray | None = None
) -> str:
    """A sentence that names the likely mistake and begins with a space, or an empty text. value: of the rig file;
    estimate: estimate of the same group; rotation: estimated R_imu_sensor (3, 3), needed for an inverse translation."""
    name = key[1]
    if name == "rotation":
        return _frames(value, estimate)
    if name == "translation" and rotation is not None:
        inverse = -rotation.T @ estimate
        if is_near(value, inverse, NEARLY) and not is_near(value, estimate, NEARLY):
            return " It looks like that of the inverse: icalib wants p_imu_sensor."
    sensor = rig.sensors.get(key[0])
    for size, unit in (LENGTHS if sensor is not None and sensor.spec(name).unit == "m" else {}).items():
        if is_near(estimate, size * value, NEARLY):
            return f" It looks like {unit}: write metres."
    if name == "time_offset" and is_near(estimate, 1e-3 * value, NEARLY):
        return " It looks like milliseconds: write seconds."
    if name == "intrinsics":
        for size in IMAGE_SIZES:
            if is_near(estimate[:2], size * value[:2], NEARLY):
                return f" The focal length is {size:g} times that: was it of images of another size?"
    if sensor is None:
        return ""
    return call_kind(sensor.sensor_type, "assess", "looks_like", sensor, name, value, estimate) or ""


def _frames(value: np.ndarray, estimate: np.ndarray) -> str:
    """The sentence for a rotation that is inverted, or in a frame with other axes."""
    if _angle(value.T, estimate) < NEAR_RAD:
        return " It looks like the inverse, as in Kalibr's T_cam_imu: icalib wants R_imu_sensor."
    if min(_angle(value @ turn, estimate) for turn in TURNS if np.linalg.det(turn) > 0.0) < NEAR_RAD:
        return " It looks like that of a frame whose axes are named otherwise, as a link's and a camera's are."
    return ""


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """Angle [rad] between the rotations a and b (3, 3)."""
    return float(np.linalg.norm(so3.log(np.ascontiguousarray(a.T @ b))))
