"""Extrinsics and time offsets that the rig file gives, with offsets relative to the first stamps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.estimate.problem.inputs import Inputs, origin_difference
from icalib.initialize.steps.single_recording import KnownExtrinsics
from icalib.optim.state import Key
from icalib.rig import Parameter, Sensor
from icalib.sensors.sensor import MOUNTED_NAMES


def known_value(parameter: Parameter) -> np.ndarray | None:
    """The value of a parameter that is fixed or has a prior, else None. A mere guess may be far off, so other guesses
    must not depend on it."""
    return None if parameter.mode == "free" else parameter.value


def stated_values(inputs: Inputs, sensor: Sensor, names: Sequence[str] | None = None) -> dict[Key, np.ndarray]:
    """Values that the rig file gives for the parameters `names`, by default extrinsics and time offset, whatever their
    mode. Time offsets refer to first stamps; a clock that restarts has one for each recording."""
    out: dict[Key, np.ndarray] = {}
    for name in mounted_names(sensor) if names is None else names:
        value = getattr(sensor, name).value
        if value is not None:
            shift = origin_difference(inputs.measurements, inputs.stream(sensor.name)) if name == "time_offset" else 0.0
            out[sensor.name, name] = np.array(value, dtype=np.float64) + shift
    if (offset := out.get((sensor.name, "time_offset"))) is not None:
        out[sensor.name, "time_offset"] = np.repeat(offset, inputs.clocks_of(sensor))
    return out


def mounted_names(sensor: Sensor) -> list[str]:
    """Names of the extrinsics and time offset that this kind of sensor has."""
    return [spec.name for spec in sensor.specs() if spec.name in MOUNTED_NAMES]


def known_names(sensor: Sensor) -> list[str]:
    """Names of the extrinsics and time offset that are fixed or have a prior."""
    return [name for name in mounted_names(sensor) if known_value(getattr(sensor, name)) is not None]


def known_extrinsics(inputs: Inputs, sensor: Sensor, guesses: bool = False) -> KnownExtrinsics:
    """Extrinsics and time offset that the rig file fixes or gives a prior for; with `guesses`, those that it only
    guesses as well."""
    known = stated_values(inputs, sensor, mounted_names(sensor) if guesses else known_names(sensor))
    offset = known.get((sensor.name, "time_offset"))
    return KnownExtrinsics(
        known.get((sensor.name, "rotation")),
        known.get((sensor.name, "translation")),
        None if offset is None else float(offset[0]),
    )
