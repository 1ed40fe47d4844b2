"""What each kind of sensor declares to the simulator and to `inspect`."""

from __future__ import annotations

import re
from itertools import combinations

import numpy as np
from tests.cases import each

from icalib.rig.rig import SENSOR_TYPES
from icalib.sensors.camera.spec import Camera
from icalib.tools.inspection.facts import inspectors
from icalib.tools.simulation.scenario import SimSensor, simulated_kinds

OTHERS = [name for name, kind in SENSOR_TYPES.items() if kind is not Camera]


def test_every_kind_is_simulated_and_inspected():
    assert list(simulated_kinds()) == OTHERS and list(inspectors()) == list(SENSOR_TYPES)


def test_streams_of_random_numbers_are_apart():
    first = [kind.random_stream for kind in simulated_kinds().values()]
    assert all(abs(a - b) >= 1000 for a, b in combinations(first, 2)) and min(first) >= 1000


@each("kind", OTHERS)
def test_a_kind_declares_what_its_sensors_have(kind: str):
    simulated, inspector = simulated_kinds()[kind], inspectors()[kind]
    assert issubclass(simulated, SimSensor) and simulated.sensor_type == kind
    assert inspector.sensor.sensor_type == kind and inspector.topic_kinds
    sensor = simulated("sensor0", np.eye(4))
    entry = sensor.rig_entry()
    assert type(entry) is inspector.sensor and entry.name == "sensor0"
    known = {spec.name: spec for spec in entry.parameters}
    values = sensor.true_parameters().values
    assert {name: value.shape for name, value in values.items()} == {name: (known[name].size,) for name in values}
    assert all(hasattr(sensor, field) for field, _ in simulated.effects.values())


@each("kind", SENSOR_TYPES)
def test_names_of_topics_are_no_names_of_sensors(kind: str):
    inspector = inspectors()[kind]
    assert not re.fullmatch(inspector.plain_names, f"{inspector.prefix}0")
