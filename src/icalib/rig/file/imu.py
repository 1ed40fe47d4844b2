"""An IMU in the rig file: its noise, units, axes and topics, and back to plain data."""

from __future__ import annotations

import dataclasses
from typing import Any, get_args

from icalib.base.yaml_nodes import YamlValue
from icalib.rig import AccelUnit, GyroUnit, ImuNoise, ImuSensor, TwoSources
from icalib.rig.file.fields import TABLE, axes_or_none, layout_to_plain, table_layout
from icalib.rig.file.parameters import imu_intrinsics_parameter, parameter_to_plain
from icalib.rig.imu_classes import DEFAULT_CLASS, IMU_CLASSES, class_noise

_DENSITIES = ("gyro", "gyro_walk", "accel", "accel_walk")
_FIELDS = ("accel_unit", "gyro_unit", "accel_axes", "gyro_axes")


def read_imu(name: str, value: YamlValue) -> ImuSensor:
    """Raises RigError, one sentence naming file, line and field."""
    names = [spec.name for spec in ImuSensor.stated()]
    found = value.record(("type",), ("path", "topic", "noise", *names, *_FIELDS, *TABLE))
    units: dict[str, Any] = {
        field: found[field].choice("such unit as", get_args(kind))
        for field, kind in (("accel_unit", AccelUnit), ("gyro_unit", GyroUnit))
        if field in found
    }
    groups: dict[str, Any] = {name: imu_intrinsics_parameter(found[name]) for name in names if name in found}
    return ImuSensor(
        name=name,
        path=_source(found["path"]) if "path" in found else f"{name}/data.csv",
        noise=_noise(found["noise"]) if "noise" in found else class_noise(DEFAULT_CLASS),
        topic=_source(found["topic"]) if "topic" in found else None,
        accel_axes=axes_or_none(found, "accel_axes"),
        gyro_axes=axes_or_none(found, "gyro_axes"),
        layout=table_layout(found),
        **units,
        **groups,
    )


def imu_to_plain(imu: ImuSensor) -> dict[str, Any]:
    """The fields of `imu` that load back as the same."""
    plain: dict[str, Any] = {"type": "imu", "path": _plain_source(imu.path), "noise": dataclasses.asdict(imu.noise)}
    plain |= layout_to_plain(imu.layout)
    if imu.topic is not None:
        plain["topic"] = _plain_source(imu.topic)
    for field in _FIELDS:
        given = getattr(imu, field)
        if given is not None:
            plain[field] = list(given) if isinstance(given, tuple) else given
    groups = {spec.name: getattr(imu, spec.name) for spec in ImuSensor.stated()}
    ideal = [name for name, p in groups.items() if p.mode == "fixed" and p.value is None]
    return plain | {name: "fixed" if name in ideal else parameter_to_plain(p) for name, p in groups.items()}


def _noise(value: YamlValue) -> ImuNoise:
    if not value.is_mapping:
        return class_noise(value.choice("IMU class", IMU_CLASSES))
    found = value.record(_DENSITIES, ("source",))
    densities = {name: found[name].positive() for name in _DENSITIES}
    return ImuNoise(**densities, source=found["source"].text() if "source" in found else ImuNoise.source)


def _source(value: YamlValue) -> str | TwoSources:
    """One name, or one for each of the two sensors."""
    if not value.is_mapping:
        return value.text()
    found = value.record(("gyro", "accel"))
    return TwoSources(found["gyro"].text(), found["accel"].text())


def _plain_source(source: str | TwoSources) -> str | dict[str, str]:
    return dataclasses.asdict(source) if isinstance(source, TwoSources) else source
