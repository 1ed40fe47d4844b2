"""Reads `effects` of a scenario file: errors of real sensors and targets. The format is in docs/simulation.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.tools.simulation.scenario.sensor import SimSensor, simulated_kinds

# Field of the IMU -> indices of its numbers in `Scenario.imu_intrinsics`.
_IMU = {
    "accel_scale": (0, 2, 5),
    "accel_misalignment": (1, 3, 4),
    "gyro_scale": (6, 8, 11),
    "gyro_misalignment": (7, 9, 10),
    "accel_rotation": (12, 13, 14),
    "g_sensitivity": tuple(range(15, 24)),
}
_LARGEST = 0.2  # limit of a relative error, which no usable sensor exceeds


def read_effects(value: YamlValue, sensors: Sequence[SimSensor]) -> dict[str, Any]:
    """The fields of `Scenario` that effects change, by name. value: the section; sensors: those of the scenario file.
    Raises RigError naming file, line and field."""
    scales = {effect: (kind, field) for kind in simulated_kinds().values() for effect, field in kind.effects.items()}
    fields, changed = value.record((), ("imu", "target_size", *scales)), {}
    if "imu" in fields:
        changed["imu_intrinsics"] = _intrinsics(fields["imu"])
    if "target_size" in fields:
        changed["target_size"] = _ratio(fields["target_size"])
    for effect in scales.keys() & fields.keys():
        sensors = _scaled(fields[effect], sensors, *scales[effect])
        changed["sensors"] = sensors
    return changed


def _scaled(value: YamlValue, sensors: Sequence[SimSensor], kind: type[SimSensor], field: str) -> tuple[SimSensor, ...]:
    """The sensors, with `field` of those of `kind` set to the ratio that `value` gives for their names."""
    ratios = value.record((), tuple(s.name for s in sensors if isinstance(s, kind)))
    by_name = {name: _ratio(ratio) for name, ratio in ratios.items()}
    return tuple(replace(s, **{field: by_name[s.name]}) if s.name in by_name else s for s in sensors)


def _intrinsics(value: YamlValue) -> np.ndarray:
    """(24,) IMU intrinsics, in the order of `Scenario.imu_intrinsics`."""
    intrinsics = np.zeros(24)
    for name, numbers in value.record((), tuple(_IMU)).items():
        values = numbers.vector(len(_IMU[name]))
        if np.abs(values).max() > _LARGEST:
            numbers.fail(f"must be between {-_LARGEST} and {_LARGEST}: 0.01 is 1 %, or 10 mrad.")
        intrinsics[list(_IMU[name])] = values
    return intrinsics


def _ratio(value: YamlValue) -> float:
    ratio = value.number()
    if abs(ratio - 1.0) > _LARGEST:
        value.fail(f"is true over stated length, between {1.0 - _LARGEST} and {1.0 + _LARGEST}, but is {ratio:g}.")
    return ratio
