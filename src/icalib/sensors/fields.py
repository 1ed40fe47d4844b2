"""Rig-file fields that several kinds of sensors share: parsing, and conversion back to plain data."""

from __future__ import annotations

from collections.abc import Iterable
from math import radians
from typing import Any, get_args

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.errors import RigError
from icalib.sensors.parameter import ROUNDING, Parameter, ParameterSpec, nearest_rotation
from icalib.sensors.sensor import PLAIN_TABLE, Axes, Sensor, TableLayout, TimeUnit

TABLE = ("columns", "time_unit")


def parameter_fields(sensor: type[Sensor]) -> tuple[str, ...]:
    """Names of the fields that `parameters` reads."""
    return (*(spec.name for spec in sensor.stated()), "clock_restarts")


def parameters(fields: dict[str, YamlValue], specs: Iterable[ParameterSpec]) -> dict[str, Any]:
    """Keyword arguments of a sensor: those parameters of `specs`, and clock_restarts, that the rig file has."""
    groups: dict[str, Any] = {spec.name: parameter(fields[spec.name], spec) for spec in specs if spec.name in fields}
    for spec in specs:
        value = groups[spec.name].value if spec.name in groups else None
        if value is not None and np.abs(value).max(initial=0.0) > spec.largest:
            fields[spec.name].fail(f"is in {spec.unit}, and at most {spec.largest:g} {spec.unit}; correct it.")
    if "clock_restarts" in fields:
        groups["clock_restarts"] = fields["clock_restarts"].boolean()
        if groups["clock_restarts"] and "time_offset" in groups and groups["time_offset"].mode == "fixed":
            fields["clock_restarts"].fail(
                "each recording has its own time offset, but time_offset is fixed; remove one of them."
            )
    return groups


def positive_or(fields: dict[str, YamlValue], name: str, default: float) -> float:
    return fields[name].positive() if name in fields else default


def choice_or(fields: dict[str, YamlValue], name: str, kind: Any, default: Any) -> Any:
    return fields[name].choice("such choice as", get_args(kind)) if name in fields else default


def axes_or_none(fields: dict[str, YamlValue], name: str) -> Axes | None:
    """The recorded columns that become x, y, z, with signs, such as ("x", "-y", "-z"); None if the field is missing."""
    if name not in fields:
        return None
    entries = [entry.text() for entry in fields[name].items()]
    if len(entries) != 3 or sorted(e.removeprefix("-") for e in entries) != ["x", "y", "z"]:
        fields[name].fail(
            "must name the columns that become x, y and z, each once, with - for a reversed sign, as in [x, "
            "-y, -z]; correct it."
        )
    return entries[0], entries[1], entries[2]


def path_or(fields: dict[str, YamlValue], default: str) -> str:
    return fields["path"].text() if "path" in fields else default


def table_layout(fields: dict[str, YamlValue]) -> TableLayout:
    """The layout of the sensor's table, from the fields of `TABLE`."""
    if not set(TABLE) & set(fields):
        return PLAIN_TABLE
    columns = tuple(item.text() for item in fields["columns"].items()) if "columns" in fields else ()
    if "columns" in fields and len(set(columns)) < max(len(columns), 1):
        fields["columns"].fail("must name columns of the table, each once; correct it.")
    return TableLayout(columns, choice_or(fields, "time_unit", TimeUnit, None))


def layout_to_plain(layout: TableLayout) -> dict[str, Any]:
    columns = {"columns": list(layout.columns)} if layout.columns else {}
    return columns | ({"time_unit": layout.time_unit} if layout.time_unit else {})


def topic_or_none(fields: dict[str, YamlValue]) -> str | None:
    return fields["topic"].text() if "topic" in fields else None


def groups_to_plain(sensor: Sensor) -> dict[str, Any]:
    """The parameters of the sensor as plain data by name, but for those fixed at their default, and clock_restarts if
    it is true."""
    plain = {spec.name: parameter_to_plain(getattr(sensor, spec.name)) for spec in sensor.stated()}
    plain = {name: value for name, value in plain.items() if value is not None}
    return plain | ({"clock_restarts": True} if sensor.clock_restarts else {})


# Parameter groups of the rig file (free, guess, fixed or prior): parsing, and conversion back to plain data.

_FORMS = "write free, {guess: VALUE}, {fixed: VALUE} or {prior: VALUE, sigma: SIGMA}"
_ROTATION_FORMS = "a 3x3 matrix, {xyzw: [x, y, z, w]} or {rpy_deg: [roll, pitch, yaw]}"


def parameter(value: YamlValue, spec: ParameterSpec) -> Parameter:
    """Parses the parameter group that `spec` defines. Raises RigError naming line and field."""
    return rotation_parameter(value) if spec.manifold == "rotation" else vector_parameter(value, spec.size)


def vector_parameter(value: YamlValue, size: int) -> Parameter:
    """Parses a group of `size` numbers. Raises RigError naming line and field."""
    mode, fields = _mode(value, ("sigma",))
    if fields is None:
        return Parameter("free")
    mean = fields[mode].vector(size)
    if mode != "prior":
        return Parameter("free" if mode == "guess" else "fixed", mean)
    return Parameter("prior", mean, _sigma(fields["sigma"], size))


def rotation_parameter(value: YamlValue) -> Parameter:
    """Parses a rotation R_imu_sensor with `sigma` in rad or `sigma_deg`. Raises RigError naming line and field."""
    mode, fields = _mode(value, ("sigma", "sigma_deg"))
    if fields is None:
        return Parameter("free")
    matrix = _rotation(fields[mode])
    if mode != "prior":
        return Parameter("free" if mode == "guess" else "fixed", matrix)
    if "sigma_deg" in fields:
        return Parameter("prior", matrix, np.deg2rad(_sigma(fields["sigma_deg"], 3)))
    return Parameter("prior", matrix, _sigma(fields["sigma"], 3))


def parameter_to_plain(parameter: Parameter) -> Any:
    """`parameter` as lists, numbers and text of the rig file; None for a group fixed at its default, without a
    value."""
    if parameter.value is None:
        return "free" if parameter.mode == "free" else None
    key = "guess" if parameter.mode == "free" else parameter.mode
    plain: dict[str, Any] = {key: parameter.value.tolist()}
    if parameter.sigma is not None:
        plain["sigma"] = parameter.sigma.tolist()
    return plain


def _mode(value: YamlValue, sigmas: tuple[str, ...]) -> tuple[str, dict[str, YamlValue] | None]:
    """The mode (guess, fixed or prior) and all fields of the mapping; ("free", None) for the text `free`. Raises
    RigError."""
    if not value.is_mapping:
        if value.is_list or value.text() != "free":
            value.fail(f"must be free or a mapping, but is {value.summary()}; {_FORMS}.")
        return "free", None
    fields = value.record((), ("guess", "fixed", "prior", *sigmas))
    modes = [name for name in ("guess", "fixed", "prior") if name in fields]
    if len(modes) != 1:
        value.fail(f"needs exactly one of guess, fixed and prior, but has {' and '.join(modes) or 'none'}; {_FORMS}.")
    given = [name for name in sigmas if name in fields]
    if modes[0] == "prior" and len(given) != 1:
        value.fail(f"a prior needs exactly one of {' and '.join(sigmas)}; {_FORMS}.")
    if modes[0] != "prior" and given:
        fields[given[0]].fail(f"belongs to a prior, not to {modes[0]}; {_FORMS}.")
    return modes[0], fields


def _sigma(value: YamlValue, size: int) -> np.ndarray:
    """(size,) standard deviations, from a list or from one number for all. Raises RigError unless they are above 0."""
    sigma = value.vector(size) if value.is_list else np.full(size, value.number())
    if (sigma <= 0).any():
        value.fail(
            f"a standard deviation must be above 0, but is {sigma.min():g}; write fixed for a value without "
            "uncertainty."
        )
    return sigma


def _rotation(value: YamlValue) -> np.ndarray:
    """(3, 3) rotation from a matrix, a quaternion or rpy_deg; a matrix with rounded digits is made orthonormal. Raises
    RigError."""
    if value.is_list:
        return _matrix(value)
    if not value.is_mapping:
        value.fail(f"must be a rotation, {_ROTATION_FORMS}, but is {value.summary()}.")
    fields = value.record((), ("xyzw", "rpy_deg"))
    if len(fields) != 1:
        value.fail(f"must be one rotation; write {_ROTATION_FORMS}.")
    if "xyzw" in fields:
        return _from_quaternion(fields["xyzw"])
    return rotation_of_rpy(*(radians(angle) for angle in fields["rpy_deg"].vector(3)))


def _matrix(value: YamlValue) -> np.ndarray:
    rows = value.items()
    if len(rows) != 3:
        value.fail(f"a rotation matrix has 3 rows of 3 numbers, but this has {len(rows)}; write {_ROTATION_FORMS}.")
    matrix = np.array([row.vector(3) for row in rows])
    try:
        return nearest_rotation(matrix)
    except RigError as error:
        value.fail(f"{error}; write {_ROTATION_FORMS}.")


def _from_quaternion(value: YamlValue) -> np.ndarray:
    q = value.vector(4)
    norm = float(np.linalg.norm(q))
    if abs(norm - 1) > ROUNDING:
        value.fail(f"a unit quaternion [x, y, z, w] has norm 1, but this has {norm:.4g}; normalise it.")
    x, y, z, w = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_of_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Rz(yaw) Ry(pitch) Rx(roll), angles in rad."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return rz @ ry @ rx
