"""`effects` of a scenario: how real sensors and targets differ from the ideal. The format: docs/simulation.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.tools.simulation.scenario.robot import SimPoses

# Field of the IMU -> where its numbers stand in `Scenario.imu_intrinsics`.
_IMU = {
    "accel_scale": (0, 2, 5),
    "accel_misalignment": (1, 3, 4),
    "gyro_scale": (6, 8, 11),
    "gyro_misalignment": (7, 9, 10),
    "gyro_rotation": (12, 13, 14),
    "g_sensitivity": tuple(range(15, 24)),
}
_LARGEST = 0.2  # of a relative error: the recording is that of another sensor


def read_effects(value: YamlValue, poses: Sequence[SimPoses]) -> dict[str, Any]:
    """The fields of `Scenario` that effects change; `poses`: its pose sensors. Raises RigError naming file, line and
    field."""
    found, changed = value.record((), ("imu", "target_size", "pose_scale")), {}
    if "imu" in found:
        changed["imu_intrinsics"] = _intrinsics(found["imu"])
    if "target_size" in found:
        changed["target_size"] = _ratio(found["target_size"])
    if "pose_scale" in found:
        scales = found["pose_scale"].record((), tuple(p.name for p in poses))
        by_name = {name: _ratio(scale) for name, scale in scales.items()}
        changed["poses"] = tuple(replace(p, scale=by_name.get(p.name, p.scale)) for p in poses)
    return changed


def _intrinsics(value: YamlValue) -> np.ndarray:
    """(24,) as in `Scenario`."""
    intrinsics = np.zeros(24)
    for name, numbers in value.record((), tuple(_IMU)).items():
        own = numbers.vector(len(_IMU[name]))
        if np.abs(own).max() > _LARGEST:
            numbers.fail(f"must be between {-_LARGEST} and {_LARGEST}: 0.01 is 1 %, or 10 mrad.")
        intrinsics[list(_IMU[name])] = own
    return intrinsics


def _ratio(value: YamlValue) -> float:
    ratio = value.number()
    if abs(ratio - 1.0) > _LARGEST:
        value.fail(f"is true over stated length, between {1.0 - _LARGEST} and {1.0 + _LARGEST}, but is {ratio:g}.")
    return ratio
