"""Rig files: reading, and conversion of a `Rig` to plain data for writing. The format: docs/rig-file.md."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import yaml

from icalib.base.files import NAME, NAME_WORDS
from icalib.base.yaml_nodes import YamlValue, parse_yaml, read_yaml, suggestion
from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Circles, Markers, NoTarget, Scene, Target
from icalib.geometry.targets.families import family_name
from icalib.rig.rig import ANYWHERE, SENSOR_TYPES, Gravity, Rig, Settings, by_name, gravity_to_plain, parse_gravity
from icalib.sensors.sensor import CLOCK_RATE, MOUNTED_NAMES, TARGET_FRAME, Lack, Sensor, has_imu


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


# Parses targets of a rig file: the field `target`, or several by name in the field `targets`.

# type -> required fields, optional fields
_FIELDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "aprilgrid": (("rows", "cols", "tag_size", "tag_spacing"), ("border_bits", "squares", "first_id", "family")),
    "charuco": (("squares_x", "squares_y", "square_size", "marker_size", "dictionary"), ("legacy", "inverted")),
    "checkerboard": (("rows", "cols", "square_size"), ("inverted", "upright")),
    "circles": (("rows", "cols", "spacing", "diameter"), ("asymmetric",)),
    "markers": (("family", "size"), ("ids", "border_bits")),
}
_LARGEST_TAG_M = 2.0  # a larger value is probably in millimetres
_MOST_TAGS = 10_000
_LARGEST_SIGMA = 0.2  # relative; a larger value is probably in percent


def target_or_targets(root: YamlValue) -> Target:
    """The target in the field `target` or `targets` of the file; several targets are combined into a `Scene`.

    Raises RigError with file, line and field, what is wrong and what to do.
    """
    fields = root.entries()
    if "target" not in fields and "targets" not in fields:
        root.fail("target is missing; add target, or targets for several by name.")
    if "targets" not in fields:
        return target_of(fields["target"])
    if "target" in fields:
        fields["targets"].fail("conflicts with target; put all targets under targets.")
    named = fields["targets"].entries()
    for name, value in named.items():
        if not NAME.fullmatch(name):
            value.fail(f"a target's name is {NAME_WORDS}, as in wall; rename it.")
    if not named:
        fields["targets"].fail("there is no target; add one, as in wall: {type: markers, ...}.")
    targets = tuple(target_of(value) for value in named.values())
    return targets[0] if len(targets) == 1 else _checked_target(fields["targets"], lambda: Scene(tuple(named), targets))


def target_of(value: YamlValue) -> Target:
    """One target from the mapping of its fields. Raises RigError as `target_or_targets`."""
    entries = value.entries()
    if "type" not in entries:
        value.fail(f"type is missing; add type: {', type: '.join(_FIELDS)}.")
    kind = entries["type"].choice("target type", tuple(_FIELDS))
    required, optional = _FIELDS[kind]
    fields = value.record(("type", *required), (*optional, "size_sigma", "sheet"))
    target = _of_kind(kind, value, fields)
    if "sheet" in fields:
        target = replace(target, sheet=_sheet(fields["sheet"], target))
    return replace(target, size_sigma=_size_sigma(fields["size_sigma"])) if "size_sigma" in fields else target


def _sheet(value: YamlValue, target: Target) -> tuple[float, float]:
    """Width and height [m] of the sheet that `target` is printed on, along its x and y."""
    sides = value.items()
    if len(sides) != 2 or len(target.bodies) != 1:
        value.fail("is [width, height] in metres, of a target of a single body; write two numbers, or remove it.")
    width, height = (side.positive() for side in sides)
    needed = np.ptp(target.points[:, :2], axis=0)
    if width < needed[0] or height < needed[1]:
        value.fail(
            f"is smaller than the {needed[0]:.3g} x {needed[1]:.3g} m that its points span along x and y; write "
            "[width, height] in metres, in the order of the target's axes."
        )
    return width, height


def _size_sigma(value: YamlValue) -> float:
    if not 0.0 <= (sigma := value.number()) < _LARGEST_SIGMA:
        value.fail(
            f"is a share of the size between 0 (exact) and {_LARGEST_SIGMA}, but is {sigma:g}; write 0.002 for 0.2 %."
        )
    return sigma


def _of_kind(kind: str, value: YamlValue, fields: dict[str, YamlValue]) -> Target:
    if kind == "aprilgrid":
        return _aprilgrid(value, fields)
    if kind == "markers":
        return _markers(value, fields)
    if kind == "circles":
        counts, spacing = _counts(value, fields, "rows", "cols", "circles"), _edge(fields["spacing"], "spacing")
        diameter = _edge(fields["diameter"], "circle")
        return _checked_target(value, lambda: Circles(*counts, spacing, diameter, _yes(fields, "asymmetric")))
    size = _edge(fields["square_size"], "square")
    if kind == "checkerboard":
        rows, cols = _counts(value, fields, "rows", "cols", "corners")
        return _checked_target(
            value, lambda: Checkerboard(rows, cols, size, _yes(fields, "inverted"), _yes(fields, "upright"))
        )
    squares = _counts(value, fields, "squares_x", "squares_y", "squares")
    marker, dictionary = _edge(fields["marker_size"], "tag"), _family(fields["dictionary"])
    how = _yes(fields, "legacy"), _yes(fields, "inverted")
    return _checked_target(value, lambda: Charuco(*squares, size, marker, dictionary, *how))


def _aprilgrid(value: YamlValue, fields: dict[str, YamlValue]) -> Target:
    size = _edge(fields["tag_size"], "tag")
    rows, cols = _counts(value, fields, "rows", "cols", "tags")
    squares = fields["squares"].boolean() if "squares" in fields else True
    spacing, border = fields["tag_spacing"].positive(), _border(fields, AprilGrid.border_bits)
    first = fields["first_id"].whole(0) if "first_id" in fields else AprilGrid.first_id
    family = _family(fields["family"]) if "family" in fields else AprilGrid.family
    return _checked_target(value, lambda: AprilGrid(rows, cols, size, spacing, border, squares, first, family))


def _markers(value: YamlValue, fields: dict[str, YamlValue]) -> Target:
    family, size = _family(fields["family"]), _edge(fields["size"], "tag")
    ids = tuple(entry.whole(0) for entry in fields["ids"].items()) if "ids" in fields else ()
    if "ids" in fields and not ids:
        fields["ids"].fail("the list of ids is empty; list them, or remove ids to use all tags that are seen.")
    return _checked_target(value, lambda: Markers(family, size, ids, _border(fields, Markers.border_bits)))


def _family(value: YamlValue) -> str:
    try:
        return family_name(value.text())
    except RigError as error:
        value.fail(str(error))


def _yes(fields: dict[str, YamlValue], name: str) -> bool:
    return fields[name].boolean() if name in fields else False


def _border(fields: dict[str, YamlValue], default: int) -> int:
    return int(fields["border_bits"].choice("width of border", ("1", "2"))) if "border_bits" in fields else default


def _edge(value: YamlValue, noun: str) -> float:
    if (size := value.positive()) > _LARGEST_TAG_M:
        value.fail(f"is in metres, and {size:g} m is too large for a {noun}; write 0.088 for 88 mm.")
    return size


def _counts(value: YamlValue, fields: dict[str, YamlValue], first: str, second: str, noun: str) -> tuple[int, int]:
    a, b = fields[first].whole(1), fields[second].whole(1)
    if a * b > _MOST_TAGS:
        value.fail(f"{a} x {b} {noun} exceed the limit of {_MOST_TAGS}; correct {first} and {second}.")
    return a, b


def _checked_target(value: YamlValue, make: Callable[[], Target]) -> Target:
    try:
        return make()
    except RigError as error:
        value.fail(str(error))


# Checks that the sensors of a rig can be calibrated together: at least one must determine the motion of the rig.


def lack_of(rig: Rig) -> Lack | None:
    """The first reason why the sensors of the rig cannot be calibrated together; None if they can."""
    return next(_lacks(rig), None)


def check_complete(rig: Rig) -> None:
    """Raises RigError if the sensors of the rig cannot be calibrated together (see `lack_of`)."""
    lack = lack_of(rig)
    if lack is None:
        return
    place = ".".join(lack.where[1:])
    raise RigError(f"{place}{':' * (len(lack.where) > 2)} {lack.sentence}" if place else lack.sentence)


def _lacks(rig: Rig) -> Iterator[Lack]:
    yield from _mounted_body(rig)
    if rig.body and rig.body not in rig.sensors:
        near = suggestion(rig.body, rig.sensors)
        yield Lack(("body",), f"there is no sensor {rig.body}{near}; available are {', '.join(rig.sensors)}.")
    if not any(sensor.gives_motion or sensor.is_inertial for sensor in rig.mounted):
        yield Lack(("sensors",), _no_motion(rig))
    for sensor in rig.sensors.values():
        yield from sensor.lacks(rig.sensors, rig.has_target)
    yield from _unknown_frames(rig)
    if not has_imu(rig.sensors):
        yield from _clocks_without_reference(rig)
    plane_sensor = any(s.shows_planes for s in rig.mounted)
    if rig.settings.points_on_planes_m > 0.0 and not (plane_sensor and any(s.tracks_points for s in rig.mounted)):
        yield Lack(
            ("settings", "points_on_planes_m"),
            "needs a LiDAR that sees planes, and a camera with feature tracks; remove it.",
        )


def _mounted_body(rig: Rig) -> Iterator[Lack]:
    """Extrinsics or a clock of the IMU to which those of all other sensors refer."""
    others = " or ".join(s.name for s in rig.further_imus)
    if (imu := rig.imu) is None:
        return
    for name in (*MOUNTED_NAMES, CLOCK_RATE.name):
        stated = getattr(imu, name)
        if stated.mode != getattr(type(imu), name).mode or stated.value is not None:
            advice = f", or make {others} the body with body: {rig.further_imus[0].name}" if others else ""
            yield Lack(
                ("sensors", imu.name, name), f"{imu.name} is the body, to which this would refer; remove it{advice}."
            )


def _unknown_frames(rig: Rig) -> Iterator[Lack]:
    """Sensors that report in the frame of another sensor or of the target, if that frame does not exist. A target of
    several bodies has no frame."""
    for sensor in rig.mounted:
        name, where = sensor.shared_frame, ("sensors", sensor.name, "frame")
        if name == TARGET_FRAME and len(rig.target.bodies) > 1:
            yield Lack(where, f"a target of {len(rig.target.bodies)} bodies has no frame of its own; write levelled.")
        frames = [TARGET_FRAME] * rig.has_target + [s.name for s in rig.mounted if s.has_frame]
        if name and name not in frames:
            valid = ("levelled", "tilted", *frames)
            sentence = f"there is no frame {name}{suggestion(name, valid)}; available are {', '.join(valid)}."
            yield Lack(where, sentence)


def _no_motion(rig: Rig) -> str:
    nouns = [kind.noun for kind in SENSOR_TYPES.values() if kind.gives_motion]
    names = " and ".join(s.name for s in (*rig.mounted, rig.imu) if s is not None)
    alone = f"{names} do not determine the motion, and " if rig.mounted else ""
    missing = f"no {', no '.join(nouns[:-1])} and no {nouns[-1]}"
    return f"{alone}there is {missing}; add one of them."


def _clocks_without_reference(rig: Rig) -> Iterator[Lack]:
    """Sensors with `clock_restarts` but without a time offset, for rigs without an IMU: all sensors of a rig with
    cameras only, and the reference sensor."""
    for sensor in rig.mounted:
        if not sensor.clock_restarts:
            continue
        where = ("sensors", sensor.name, "clock_restarts")
        if rig.cameras_alone:
            yield Lack(where, "cameras alone have no time offsets; remove it, or add a sensor of type: imu.")
        elif sensor.name == rig.reference:
            yield Lack(
                where,
                f"without an IMU the clock of {rig.reference} is the reference clock; set clock_restarts of the other "
                "sensors instead, or write false.",
            )
