"""Each parameter is defined once; rig file, layout, tolerances, units, labels, result and comparison read that."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from tests.cases import each

import icalib
from icalib.base.yaml_nodes import parse_yaml
from icalib.estimate.inputs import specs_of, tolerance_of
from icalib.geometry.targets import Checkerboard
from icalib.optim.state import make_layout
from icalib.rig import (
    Camera,
    ImuSensor,
    Lidar,
    Parameter,
    ParameterSpec,
    PoseSensor,
    Rig,
    Sensor,
    Settings,
    Wheels,
    by_name,
)
from icalib.rig.file import rig_from_dict, rig_to_dict
from icalib.rig.rig import ALL_SPECS, SENSOR_TYPES
from icalib.sensors.fields import groups_to_plain, parameter_fields, parameters
from icalib.sensors.imu.spec import class_noise

SOURCE = Path(icalib.__file__).parent
NAMES = {spec.name for spec in ALL_SPECS}
SENSORS: tuple[Sensor, ...] = (
    ImuSensor("imu0", "a.csv", class_noise("industrial")),
    Camera("cam0", "a.csv", "pinhole-radtan", (640, 480)),
    Camera("cam1", "a.csv", "omni-radtan", (640, 480)),
    Lidar("lidar0", "a.npz"),
    Wheels("pair0", "a.csv"),
    Wheels("steered0", "a.csv", "ackermann"),
    Wheels("twist0", "a.csv", measures="twist"),
    PoseSensor("mocap0", "a.csv"),
)


def tables(text: str) -> Iterator[tuple[int, set[str]]]:
    """Lines of the tuples, lists, sets and dictionaries in `text` that name three parameters or more; types aside."""
    tree = ast.parse(text)
    types = {id(n.slice) for n in ast.walk(tree) if isinstance(n, ast.Subscript)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Tuple | ast.List | ast.Set) and id(node) not in types:
            parts = [x.elts[0] if isinstance(x, ast.Tuple) and x.elts else x for x in node.elts]
        elif isinstance(node, ast.Dict):
            parts = [key for key in node.keys if key is not None]
        else:
            continue
        found = {p.value for p in parts if isinstance(p, ast.Constant) and isinstance(p.value, str)} & NAMES
        if len(found) >= 3:
            yield node.lineno, found


@each(
    "text", ['X = ("rotation", "translation", "bloom")', '{"radii": 2, "baseline": 1, "scales": 2}',
             'X = [("tilt", 1), ("shape", 2), ("size", 3)]']
)  # fmt: skip
def test_a_table_of_parameters_is_found(text: str):
    assert list(tables(text))
    assert not list(tables('X = Literal["rotation", "tilt", "plane"]'))


def test_no_table_lists_parameters_a_second_time():
    found = {p: list(tables(p.read_text(encoding="utf-8"))) for p in sorted(SOURCE.rglob("*.py"))}
    assert {path: listed for path, listed in found.items() if listed} == {}


@each("kind", SENSOR_TYPES.values())
def test_the_parameters_of_a_sensor_are_its_fields(kind: type[Sensor]):
    fields = {f.name for f in dataclasses.fields(kind) if f.type == "Parameter"}
    assert {spec.name for spec in kind.stated()} == fields
    assert len({spec.name for spec in kind.parameters}) == len(kind.parameters)


def test_kinds_that_share_a_name_share_its_definition():
    """Advice and units are looked up by the name of a parameter alone."""
    mounted = {spec for kind in SENSOR_TYPES.values() if not kind.is_inertial for spec in kind.parameters}
    assert len({spec.name for spec in mounted}) == len(mounted)
    assert all(kind.sensor_type == name and kind.noun for name, kind in SENSOR_TYPES.items())


@each("sensor", SENSORS)
def test_every_parameter_has_its_labels_and_a_tolerance(sensor: Sensor):
    for spec in sensor.specs():
        assert len(set(spec.labels)) == spec.size and spec.prior_sigma > 0.0
        assert (spec.labels == (spec.name,)) == (spec.size == 1)
    layout = make_layout([spec.entry(sensor.name, True) for spec in sensor.specs()])
    assert [b.name for b in layout.blocks] == [spec.name for spec in sensor.specs()]
    assert (tolerance_of(layout, specs_of(layout, [sensor]), Settings()) > 0.0).all()


def drawn(spec: ParameterSpec) -> Parameter:
    value = np.eye(3) if spec.manifold == "rotation" else 0.1 + np.arange(spec.size)
    if spec.largest < np.inf:
        value *= 0.5 * spec.largest / value.max()
    return Parameter("prior", value, 0.01 + 0.1 * np.arange(spec.size))


@each("sensor", SENSORS)
def test_every_parameter_goes_through_the_rig_file(sensor: Sensor):
    stated = [spec for spec in sensor.specs() if spec.name in {own.name for own in sensor.stated()}]
    sensor = dataclasses.replace(sensor, **{spec.name: drawn(spec) for spec in stated})
    imu = sensor if isinstance(sensor, ImuSensor) else ImuSensor("imu0", "a.csv", class_noise("consumer"))
    camera = sensor if isinstance(sensor, Camera) else Camera("eye", "a.csv", "eucm", (640, 480))
    rig = Rig(by_name(imu, camera), Checkerboard(6, 7, 0.1)).with_sensors(sensor)
    plain = rig_to_dict(rig)
    assert {spec.name for spec in stated} <= set(plain["sensors"][sensor.name])
    again = rig_to_dict(rig_from_dict(plain, "again"))
    assert again["sensors"][sensor.name] == plain["sensors"][sensor.name]


@dataclass(frozen=True)
class Bent(Lidar):
    """A LiDAR with one parameter more."""

    parameters: ClassVar[tuple[ParameterSpec, ...]] = (
        *Lidar.parameters,
        ParameterSpec("bend", 2, "vector", "rad", ("left", "up"), 1e-3, 0.02),
    )
    bend: Parameter = Parameter()


def test_a_definition_is_all_that_a_new_parameter_needs():
    value = parse_yaml("{bend: {guess: [0.1, 0.2]}, rotation: free}", "rig.yaml")
    found = value.record((), parameter_fields(Bent))
    sensor = Bent("lidar0", "", **parameters(found, Bent.stated()))
    assert groups_to_plain(sensor)["bend"] == {"guess": [0.1, 0.2]}
    layout = make_layout([spec.entry(sensor.name, True) for spec in sensor.specs()])
    specs = specs_of(layout, [sensor])
    block, spec = layout.block("lidar0", "bend"), specs["lidar0", "bend"]
    assert (block.kind, block.size, spec.display_unit[0], spec.labels) == ("vector", 2, "deg", ("left", "up"))
    np.testing.assert_array_equal(tolerance_of(layout, specs, Settings())[block.columns], 1e-3)
    with pytest.raises(icalib.CalibrationError, match="bend needs 2 numbers"):
        Bent("lidar0", "", bend=Parameter("fixed", np.zeros(3)))
