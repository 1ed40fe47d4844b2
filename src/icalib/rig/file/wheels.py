"""Wheels of the rig file, and back to plain data."""

from __future__ import annotations

from typing import Any, Literal

from icalib.base.yaml_nodes import YamlValue
from icalib.rig import (
    DRIVES,
    Ground,
    GroundPlane,
    RateUnit,
    WheelDrive,
    WheelFactor,
    WheelMeasure,
    Wheels,
)
from icalib.rig.file.fields import (
    TABLE,
    choice_or,
    groups_to_plain,
    layout_to_plain,
    parameter_fields,
    parameters,
    path_or,
    positive_or,
    table_layout,
    topic_or_none,
)

_WORDS = (
    "path", "topic", "drive", "measures", "sampling", "counts_per_turn", "counter_size", "angle_range", "rate_unit",
    "signs", "joints", "factor",
)  # fmt: skip
_NOISES = ("wheel_noise", "speed_noise", "yaw_noise", "steering_noise")
_GROUND = ("tilt_noise", "height", "height_sigma", "bump_noise")
_SLIP = ("lateral_slip", "vertical_slip")
_TURNED = ("rates", "angles", "ticks")
# Fields that go with some of `measures` only.
_ONLY_OF: dict[str, tuple[str, ...]] = {
    "sampling": ("rates", "twist"), "counts_per_turn": ("ticks",), "counter_size": ("ticks",), "joints": _TURNED,
    "angle_range": ("angles",), "rate_unit": ("rates",), "signs": (*_TURNED, "twist"),
}  # fmt: skip
# And with some kinds of wheels only.
_ONLY_OF_KIND: dict[str, tuple[str, ...]] = {
    **{spec.name: (kind,) for kind, specs in DRIVES.items() for spec in specs},
    "wheel_noise": ("pair", "steered"), "speed_noise": ("twist",), "yaw_noise": ("twist",),
    "steering_noise": ("steered",),
}  # fmt: skip
_CALLED = {"pair": "a left and a right side", "steered": "drive: ackermann", "twist": "measures: twist"}
_JOINTS = {
    "differential": ((2,), "two joints, [left, right]"),
    "skid-steer": ((4,), "four joints, [front left, rear left, front right, rear right]"),
    "ackermann": (
        (2, 4), "two joints, [driven wheel, steering], or four, [rear left, rear right, steering left, steering right]",
    ),
}  # fmt: skip


def read_wheels(name: str, value: YamlValue) -> Wheels:
    """Raises RigError naming line and field."""
    found = value.record(
        ("type",),
        (*_WORDS, "ground", *_NOISES, *_SLIP, *TABLE, *parameter_fields(Wheels)),
    )
    measures: WheelMeasure = choice_or(found, "measures", WheelMeasure, Wheels.measures)
    drive: WheelDrive = choice_or(found, "drive", WheelDrive, Wheels.drive)
    bare = Wheels(name, "", drive, measures=measures)
    _refuse_other_measures(value, found, bare)
    groups = parameters(found, bare.specs())
    _refuse_negative_lengths(found, groups, bare)
    given: dict[str, Any] = {d: positive_or(found, d, getattr(Wheels, d)) for d in (*_NOISES, *_SLIP)}
    given |= groups
    return Wheels(
        name=name,
        path=path_or(found, f"{name}/{measures}.csv"),
        drive=drive,
        factor=choice_or(found, "factor", WheelFactor, "relative-poses" if measures == "poses" else Wheels.factor),
        measures=measures,
        sampling=choice_or(found, "sampling", Literal["interval-mean", "instantaneous"], Wheels.sampling),
        counts_per_turn=found["counts_per_turn"].positive() if "counts_per_turn" in found else None,
        counter_size=found["counter_size"].whole(2) if "counter_size" in found else None,
        angle_range=found["angle_range"].positive() if "angle_range" in found else None,
        rate_unit=choice_or(found, "rate_unit", RateUnit, Wheels.rate_unit),
        signs=_signs(found["signs"], drive) if "signs" in found else None,
        topic=topic_or_none(found),
        joints=_joints(found["joints"], drive) if "joints" in found else None,
        ground=_ground(found["ground"]) if "ground" in found else None,
        layout=table_layout(found),
        **given,
    )


def _refuse_other_measures(value: YamlValue, found: dict[str, YamlValue], bare: Wheels) -> None:
    """Fields that do not go with what the wheels measure or with how they are driven, or are missing."""
    for name, measures in _ONLY_OF.items():
        if name in found and bare.measures not in measures:
            found[name].fail(
                f"belongs to wheels that measure {' or '.join(measures)}, not {bare.measures}; remove it, or correct "
                "measures."
            )
    if bare.measures == "ticks" and "counts_per_turn" not in found:
        value.fail(
            "counts_per_turn is missing; add the number of ticks per turn of the wheel, including the gear ratio."
        )
    if bare.drive != "differential" and bare.measures not in _TURNED:
        found["drive"].fail(f"goes with wheels that measure {' or '.join(_TURNED)}; remove it, or correct measures.")
    for name, kinds in _ONLY_OF_KIND.items():
        if name in found and bare.kind not in kinds:
            found[name].fail(
                f"belongs to wheels with {' or '.join(_CALLED[k] for k in kinds)}; remove it, or correct drive and "
                "measures."
            )
    _refuse_factor(found, bare)


def _refuse_factor(found: dict[str, YamlValue], bare: Wheels) -> None:
    given = found["factor"].text() if "factor" in found else None
    if bare.measures == "poses" and given == "increments":
        found["factor"].fail("relative poses have no increments of wheels; write relative-poses.")
    if bare.kind != "pair" and given == "relative-poses":
        found["factor"].fail("relative-poses (the paper's factor) needs a left and a right wheel; write increments.")


def _refuse_negative_lengths(found: dict[str, YamlValue], groups: dict[str, Any], bare: Wheels) -> None:
    for spec in bare.drive_specs:
        value = groups[spec.name].value if spec.name in groups else None
        if spec.is_positive and value is not None and (value <= 0).any():
            unit = "is in metres and" if spec.unit == "m" else "are factors and"
            found[spec.name].fail(f"{unit} must be above 0; correct it.")


def _signs(value: YamlValue, drive: WheelDrive) -> tuple[int, ...]:
    signs = [item.number() for item in value.items()]
    counts, words = _JOINTS[drive]
    if len(signs) not in counts or any(abs(s) != 1.0 for s in signs):
        value.fail(f"must be 1 or -1 for each of {words}; correct it.")
    return tuple(int(s) for s in signs)


def _joints(value: YamlValue, drive: WheelDrive) -> tuple[str, ...]:
    names = tuple(item.text() for item in value.items())
    counts, words = _JOINTS[drive]
    if len(names) not in counts or len(set(names)) < len(names):
        value.fail(f"must be the names of {words}; correct it.")
    return names


def _ground(value: YamlValue) -> Ground:
    found = value.record(("plane",), _GROUND)
    if "tilt_noise" not in found and "height_sigma" not in found:
        value.fail("has no effect; add tilt_noise (rad), or height and height_sigma (m), or both.")
    for name in ("height", "bump_noise"):
        if name in found and "height_sigma" not in found:
            found[name].fail("needs height_sigma, the uncertainty of the height (m); add it.")
    return Ground(
        choice_or(found, "plane", GroundPlane, "level"),
        tilt_noise=found["tilt_noise"].positive() if "tilt_noise" in found else None,
        height=found["height"].number() if "height" in found else Ground.height,
        height_sigma=found["height_sigma"].positive() if "height_sigma" in found else None,
        bump_noise=positive_or(found, "bump_noise", Ground.bump_noise),
    )


def _ground_to_plain(ground: Ground) -> dict[str, Any]:
    fields = [name for name in _GROUND if name == "tilt_noise" or ground.height_sigma is not None]
    plain = {name: getattr(ground, name) for name in ("plane", *fields)}
    return {name: value for name, value in plain.items() if value is not None}


def wheels_to_plain(wheels: Wheels) -> dict[str, Any]:
    """Lists, numbers and text that load back as `wheels`."""
    noises = [name for name in _NOISES if wheels.kind in _ONLY_OF_KIND[name]]
    same = ("path", "drive", "measures", "factor", *noises, *_SLIP)
    plain: dict[str, Any] = {"type": "wheels", **{name: getattr(wheels, name) for name in same}}
    given = {name: getattr(wheels, name) for name, of in _ONLY_OF.items() if wheels.measures in of}
    given |= layout_to_plain(wheels.layout)
    given["ground"] = None if wheels.ground is None else _ground_to_plain(wheels.ground)
    lists = {name: getattr(wheels, name) for name in ("joints", "signs")}
    given |= {"topic": wheels.topic, **{name: None if x is None else list(x) for name, x in lists.items()}}
    foreign = {spec.name for spec in Wheels.parameters} - {spec.name for spec in wheels.specs()}
    groups = {name: p for name, p in groups_to_plain(wheels).items() if name not in foreign}
    return plain | {name: value for name, value in given.items() if value is not None} | groups
