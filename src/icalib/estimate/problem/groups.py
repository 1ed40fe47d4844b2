"""The groups of parameters of a rig's sensors, as the rig file treats them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from icalib.rig import Parameter, Rig, Sensor


def groups_of(rig: Rig) -> Iterator[tuple[Sensor, str, Parameter]]:
    """Each group of each sensor but the IMU, with its name."""
    for sensor in rig.mounted:
        for name, value in vars(sensor).items():
            if isinstance(value, Parameter):
                yield sensor, name, value


def with_groups(rig: Rig, treated: Callable[[Sensor, str, Parameter], Parameter]) -> Rig:
    """The rig with every group as `treated` makes it from sensor, name and group."""
    changed = {sensor.name: {} for sensor in rig.mounted}
    for sensor, name, group in groups_of(rig):
        changed[sensor.name][name] = treated(sensor, name, group)
    return rig.with_sensors(*(replace(rig.sensors[name], **groups) for name, groups in changed.items()))
