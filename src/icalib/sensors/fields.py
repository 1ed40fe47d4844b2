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


def parameters(found: dict[str, YamlValue], specs: Iterable[ParameterSpec]) -> dict[str, Any]:
    """Keyword arguments of a sensor: those parameters of `specs`, and clock_restarts, that the rig file has."""
    groups: dict[str, Any] = {spec.name: parameter(found[spec.name], spec) for spec in specs if spec.name in found}
    if "clock_restarts" in found:
        groups["clock_restarts"] = found["clock_restarts"].boolean()
        if groups["clock_restarts"] and "time_offset" in groups and groups["time_offset"].mode == "fixed":
            found["clock_restarts"].fail(
                "each recording has its own time offset, but time_offset is fixed; remove one of them."
            )
    return groups


def positive_or(found: dict[str, YamlValue], name: str, default: float) -> float:
    return found[name].positive() if name in found else default


def choice_or(found: dict[str, YamlValue], name: str, kind: Any, default: Any) -> Any:
    return found[name].choice("such choice as", get_args(kind)) if name in found else default


def axes_or_none(found: dict[str, YamlValue], name: str) -> Axes | None:
    """The recorded columns that become x, y, z, with signs, such as ("x", "-y", "-z"); None if the field is missing."""
    if name not in found:
        return None
    entries = [entry.text() for entry in found[name].items()]
    if len(entries) != 3 or sorted(e.removeprefix("-") for e in entries) != ["x", "y", "z"]:
        found[name].fail(
            "must name the columns that become x, y and z, each once, with - for a reversed sign, as in [x, "
            "-y, -z]; correct it."
        )
    return entries[0], entries[1], entries[2]


def path_or(found: dict[str, YamlValue], default: str) -> str:
    return found["path"].text() if "path" in found else default


def table_layout(found: dict[str, YamlValue]) -> TableLayout:
    """The layout of the sensor's table, from the fields of `TABLE`."""
    if not set(TABLE) & set(found):
        return PLAIN_TABLE
    columns = tuple(item.text() for item in found["columns"].items()) if "columns" in found else ()
    if "columns" in found and len(set(columns)) < max(len(columns), 1):
        found["columns"].fail("must name columns of the table, each once; correct it.")
    return TableLayout(columns, choice_or(found, "time_unit", TimeUnit, None))


def layout_to_plain(layout: TableLayout) -> dict[str, Any]:
    columns = {"columns": list(layout.columns)} if layout.columns else {}
    return columns | ({"time_unit": layout.time_unit} if layout.time_unit else {})


def topic_or_none(found: dict[str, YamlValue]) -> str | None:
    return found["topic"].text() if "topic" in found else None


def groups_to_plain(sensor: Sensor) -> dict[str, Any]:
    """The parameters of the sensor as plain data by name, and clock_restarts if it is true."""
    plain = {spec.name: parameter_to_plain(getattr(sensor, spec.name)) for spec in sensor.stated()}
    return plain | ({"clock_restarts": True} if sensor.clock_restarts else {})
