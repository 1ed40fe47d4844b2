"""Rig-file fields that several kinds of sensors share: parsing, and conversion back to plain data."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, get_args

from icalib.base.yaml_nodes import YamlValue
from icalib.sensors.parameter_fields import parameter, parameter_to_plain
from icalib.sensors.parameter_spec import ParameterSpec
from icalib.sensors.sensor import PLAIN_TABLE, Axes, Sensor, TableLayout, TimeUnit

TABLE = ("columns", "time_unit")


def parameter_fields(sensor: type[Sensor]) -> tuple[str, ...]:
    """Names of the fields that `parameters` reads."""
    return (*(spec.name for spec in sensor.stated()), "clock_restarts")


def parameters(fields: dict[str, YamlValue], specs: Iterable[ParameterSpec]) -> dict[str, Any]:
    """Keyword arguments of a sensor: those parameters of `specs`, and clock_restarts, that the rig file has."""
    groups: dict[str, Any] = {spec.name: parameter(fields[spec.name], spec) for spec in specs if spec.name in fields}
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
    """The parameters of the sensor as plain data by name, and clock_restarts if it is true."""
    plain = {spec.name: parameter_to_plain(getattr(sensor, spec.name)) for spec in sensor.stated()}
    return plain | ({"clock_restarts": True} if sensor.clock_restarts else {})
