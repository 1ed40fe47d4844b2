"""All types of sensors and all definitions of parameters, from the list of kinds."""

from __future__ import annotations

from icalib.rig.scene import SCENE
from icalib.sensors import SENSOR_KINDS, facet
from icalib.sensors.sensor import Sensor

SENSOR_TYPES: dict[str, type[Sensor]] = {kind: facet(kind, "spec").SENSOR for kind in SENSOR_KINDS}
_OWN = (spec for kind in SENSOR_TYPES.values() for spec in kind.parameters)
ALL_SPECS = tuple(dict.fromkeys((*_OWN, *SCENE)))  # each once

# Of groups with a plural name, the name of one number: radius of radii.
ONE = {spec.name: spec.one for spec in ALL_SPECS if spec.one}
