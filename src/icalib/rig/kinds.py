"""Sensor classes by type, and the definitions of all parameters, collected from `SENSOR_KINDS` and `SCENE`."""

from __future__ import annotations

from icalib.rig.scene import SCENE
from icalib.sensors import SENSOR_KINDS, facet
from icalib.sensors.sensor import Sensor

SENSOR_TYPES: dict[str, type[Sensor]] = {kind: facet(kind, "spec").SENSOR for kind in SENSOR_KINDS}
_SENSOR_SPECS = (spec for kind in SENSOR_TYPES.values() for spec in kind.parameters)
ALL_SPECS = tuple(dict.fromkeys((*_SENSOR_SPECS, *SCENE)))  # without duplicates

# Parameter groups with a plural name -> name of a single number, such as radii -> radius.
ONE = {spec.name: spec.one for spec in ALL_SPECS if spec.one}
