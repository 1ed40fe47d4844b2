"""Reads fields of a scenario file that several sections share."""

from __future__ import annotations

from typing import Any

import numpy as np

from icalib.base.yaml_nodes import YamlValue

CLOCK = ("T_imu_sensor", "rate")
CLOCK_OPTIONS = ("time_offset", "phase")


def mounted_fields(
    value: YamlValue, start_ns: int, required: tuple[str, ...] = (), options: tuple[str, ...] = ()
) -> tuple[dict[str, YamlValue], dict[str, Any]]:
    """The section of a sensor on the robot. required, options: fields of its kind, beside those that all sensors have.
    Returns all fields, and the values of the common ones by their names in `SimSensor`. start_ns: origin of all clocks
    [ns]. Raises RigError naming file, line and field."""
    fields = value.record(("type", *CLOCK, *required), (*CLOCK_OPTIONS, *options))
    common = {
        "T_imu_sensor": pose(fields["T_imu_sensor"]),
        "time_offset_s": fields["time_offset"].number() if "time_offset" in fields else 0.0,
        "rate_hz": fields["rate"].positive(),
        "phase_s": at_least(fields["phase"], 0.0) if "phase" in fields else 0.0,
        "clock_origin_ns": start_ns,
    }
    return fields, common


def at_least(value: YamlValue, least: float) -> float:
    number = value.number()
    if number < least:
        value.fail(f"must be at least {least:g}, but is {number:g}.")
    return number


def share(value: YamlValue) -> float:
    number = at_least(value, 0.0)
    if number > 1.0:
        value.fail(f"must be at most 1, but is {number:g}.")
    return number


def intervals(value: YamlValue) -> tuple[tuple[float, float], ...]:
    return tuple(interval(item) for item in value.items())


def interval(value: YamlValue) -> tuple[float, float]:
    low, high = value.vector(2).tolist()
    if low > high:
        value.fail(f"must be [lowest, highest], but is [{low:g}, {high:g}].")
    return low, high


def triple(value: YamlValue) -> tuple[float, float, float]:
    """Three positive numbers."""
    sides = value.items()
    if len(sides) != 3:
        value.fail(f"must be a list of 3 numbers, but has {len(sides)}.")
    return sides[0].positive(), sides[1].positive(), sides[2].positive()


def pose(value: YamlValue) -> np.ndarray:
    """(4, 4) pose, its rotation made orthonormal."""
    rows = value.items()
    if len(rows) != 4:
        value.fail(f"must be 4 rows of 4 numbers, but has {len(rows)}.")
    T = np.array([row.vector(4) for row in rows])
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0.0 or (T[3] != [0, 0, 0, 1]).any():
        value.fail("is not a pose: its first three columns must be a rotation, its last row 0, 0, 0, 1; correct it.")
    return pose_from_rows(T)


def pose_from_rows(rows: object) -> np.ndarray:
    """4x4 pose from printed numbers: the rotation is made orthonormal (nearest in the Frobenius norm, by SVD)."""
    T = np.array(rows, dtype=np.float64)
    left, _, right = np.linalg.svd(T[:3, :3])
    T[:3, :3] = left @ right
    return T
