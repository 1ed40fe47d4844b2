"""Rig files: reading, and conversion of a `Rig` to plain data for writing. The format: docs/rig-file.md."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import yaml

from icalib.base.files import NAME, NAME_WORDS
from icalib.base.yaml_nodes import YamlValue, parse_yaml, read_yaml
from icalib.geometry.targets import NoTarget, Scene, Target
from icalib.rig.complete import lack_of
from icalib.rig.file.targets import target_of, target_or_targets
from icalib.rig.gravity import ANYWHERE, Gravity, gravity_to_plain, parse_gravity
from icalib.rig.kinds import SENSOR_TYPES
from icalib.rig.rig import Rig, by_name
from icalib.rig.settings import Settings
from icalib.sensors.sensor import Lack, Sensor


def load_rig(path: str | Path) -> Rig:
    """Read the rig file at `path`. Raises RigError with file, line and field, what is wrong and what to do."""
    file = Path(path)
    return dataclasses.replace(_rig(read_yaml(file)), path=file)


def rig_from_dict(plain: dict[str, Any], source: str) -> Rig:
    """The rig from the output of `rig_to_dict`. source: its name in messages. Raises RigError as `load_rig`."""
    return _rig(parse_yaml(yaml.safe_dump(plain, sort_keys=False), source))


def _rig(root: YamlValue) -> Rig:
    fields = root.record(("sensors",), ("target", "targets", "gravity", "settings", "body"))
    g = parse_gravity(fields["gravity"]) if "gravity" in fields else ANYWHERE
    rig = Rig(
        by_name(*(_sensor(name, value) for name, value in fields["sensors"].entries().items())),
        target_or_targets(root) if "target" in fields or "targets" in fields else NoTarget(),
        gravity=g.value,
        gravity_sigma=g.sigma,
        settings=_settings(fields["settings"]) if "settings" in fields else Settings(),
        body=fields["body"].text() if "body" in fields else "",
    )
    if (lack := lack_of(rig)) is not None:
        _place(root, lack).fail(lack.sentence)
    return rig


def _sensor(name: str, value: YamlValue) -> Sensor:
    if not NAME.fullmatch(name):
        value.fail(f"a sensor's name is {NAME_WORDS}, as in cam0; rename it.")
    fields = value.entries()
    if "type" not in fields:
        value.fail(f"type is missing; add type: {' or type: '.join(SENSOR_TYPES)}.")
    return SENSOR_TYPES[fields["type"].choice("sensor type", tuple(SENSOR_TYPES))].parse(name, value)


def _place(root: YamlValue, lack: Lack) -> YamlValue:
    """The field that `lack` concerns; if the file does not have it, the innermost enclosing one."""
    for name in lack.where:
        fields = root.entries()
        if name not in fields:
            break
        root = fields[name]
    return root


def load_target(path: str | Path) -> Target:
    """Read a target from a YAML file: the fields of a target, or a file with the field `target` or `targets`.

    Raises RigError with file, line and field, what is wrong and what to do.
    """
    root = read_yaml(Path(path))
    has_target_field = {"target", "targets"} & set(root.entries())
    return target_or_targets(root) if has_target_field else target_of(root)


def rig_to_dict(rig: Rig) -> dict[str, Any]:
    """`rig` as dicts, lists, numbers and text. Written as YAML or JSON, it loads as the same rig.

    Empty paths of sensors (a rig for measurements in memory) are omitted, and load as the default path.
    """
    sensors = {name: sensor.plain() for name, sensor in rig.sensors.items()}
    sensors = {name: {k: v for k, v in s.items() if (k, v) != ("path", "")} for name, s in sensors.items()}
    key = "targets" if isinstance(rig.target, Scene) else "target"
    target = {key: rig.target.plain()} if rig.has_target else {}
    return {
        "sensors": sensors,
        **target,
        "gravity": gravity_to_plain(Gravity(rig.gravity, rig.gravity_sigma)),
        "settings": dataclasses.asdict(rig.settings),
        **({"body": rig.body} if rig.body else {}),
    }


def _settings(value: YamlValue) -> Settings:
    kinds = get_type_hints(Settings)
    fields = value.record((), tuple(kinds))
    return Settings(**{name: _setting(name, entry, kinds[name]) for name, entry in fields.items()})


_MAY_BE_ZERO = ("outlier_std", "outlier_min_px", "points_on_planes_m")


def _setting(name: str, value: YamlValue, kind: Any) -> Any:
    if get_origin(kind) is Literal:
        return value.choice("such choice as", get_args(kind))
    if kind is bool:
        return value.boolean()
    if kind is int:
        return value.whole(0)
    return value.not_negative() if name in _MAY_BE_ZERO else value.positive()
