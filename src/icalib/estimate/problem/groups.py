"""Iteration over, and replacement of, the parameter groups of the sensors of a rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from icalib.rig import Parameter, Rig, Sensor


def groups_of(rig: Rig) -> Iterator[tuple[Sensor, str, Parameter]]:
    """Yields (sensor, name of the group, group) of all sensors but the IMU."""
    for sensor in rig.mounted:
        for name, value in vars(sensor).items():
            if isinstance(value, Parameter):
                yield sensor, name, value


def with_groups(rig: Rig, treated: Callable[[Sensor, str, Parameter], Parameter]) -> Rig:
    """The rig with each group replaced by `treated(sensor, name, group)`."""
    changed = {sensor.name: {} for sensor in rig.mounted}
    for sensor, name, group in groups_of(rig):
        changed[sensor.name][name] = treated(sensor, name, group)
    return rig.with_sensors(*(replace(rig.sensors[name], **groups) for name, groups in changed.items()))
