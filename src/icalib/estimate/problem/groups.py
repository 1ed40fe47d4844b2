"""The groups of parameters of a rig's sensors, as the rig file treats them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypeVar

from icalib.rig import Camera, Lidar, Parameter, PoseSensor, Rig, Wheels

AnySensor = Camera | Lidar | Wheels | PoseSensor
_Sensor = TypeVar("_Sensor", Camera, Lidar, Wheels, PoseSensor)


def sensors_of(rig: Rig) -> tuple[AnySensor, ...]:
    """All but the IMU."""
    return (*rig.cameras, *rig.lidars, *rig.wheels, *rig.poses)


def groups_of(rig: Rig) -> Iterator[tuple[AnySensor, str, Parameter]]:
    """Each group of each sensor but the IMU, with its name."""
    for sensor in sensors_of(rig):
        for name, value in vars(sensor).items():
            if isinstance(value, Parameter):
                yield sensor, name, value


def with_groups(rig: Rig, treated: Callable[[AnySensor, str, Parameter], Parameter]) -> Rig:
    """The rig with every group as `treated` makes it from sensor, name and group."""

    def changed(sensor: _Sensor) -> _Sensor:
        groups = {name: value for name, value in vars(sensor).items() if isinstance(value, Parameter)}
        return replace(sensor, **{name: treated(sensor, name, value) for name, value in groups.items()})

    return replace(
        rig,
        cameras=tuple(changed(c) for c in rig.cameras),
        lidars=tuple(changed(x) for x in rig.lidars),
        wheels=tuple(changed(w) for w in rig.wheels),
        poses=tuple(changed(p) for p in rig.poses),
    )
