"""Wheels in the rig file: type of drive, readings, sizes, noise and ground."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.sensors.fields import (
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
from icalib.sensors.parameter import Parameter, ParameterSpec, check_sizes
from icalib.sensors.sensor import CLOCK_RATE, MOUNTED, PLAIN_TABLE, Lack, MountedSensor, Sampling, Sensor, TableLayout

WheelFactor = Literal["increments", "relative-poses"]
WheelMeasure = Literal["rates", "angles", "ticks", "poses", "twist"]
WheelDrive = Literal["differential", "skid-steer", "ackermann"]
RateUnit = Literal["rad/s", "deg/s", "rpm"]
RATE_UNITS: dict[RateUnit, float] = {"rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": math.pi / 30.0}  # in rad/s
WheelKind = Literal["pair", "steered", "twist"]  # meaning of the two columns of a `WheelStream`

# For each kind of wheels: why their yaw rate may be opposite to that of the IMU, and how to correct it.
REVERSED_YAW: dict[WheelKind, str] = {
    "pair": "its left and right wheels are swapped, or both count backwards; swap its columns or joints, or set signs "
    "to [-1, -1] (skid-steer: [-1, -1, -1, -1]) in the rig file",
    "twist": "its yaw rate must be positive to the left; set signs to [1, -1] in the rig file",
    "steered": (
        "its steering angle must be positive to the left and its wheel must turn forwards; correct the wrong sign "
        "in the rig file: set signs to [1, -1] or to [-1, 1]"
    ),
}

# Drive parameters of each kind of wheels: those besides extrinsics and time offset.
DRIVES: dict[WheelKind, tuple[ParameterSpec, ...]] = {
    "pair": (
        ParameterSpec("radii", 2, "vector", "m", ("left", "right"), 1e-4, 0.01, True, "radius", motion="drive further"),
        ParameterSpec("baseline", 1, "vector", "m", ("baseline",), 1e-3, 0.05, True, motion="turn more, both ways"),
    ),
    "steered": (
        ParameterSpec("radius", 1, "vector", "m", ("radius",), 1e-4, 0.01, True, motion="drive further"),
        ParameterSpec("wheelbase", 1, "vector", "m", ("wheelbase",), 2e-3, 0.1, True, motion="turn more, both ways"),
        ParameterSpec(
            "steering_offset", 1, "vector", "rad", ("steering_offset",), math.radians(0.1), 0.1, motion="drive further"
        ),
    ),
    "twist": (
        ParameterSpec(
            name="scales",
            size=2,
            manifold="vector",
            unit="",
            labels=("speed", "yaw_rate"),
            tolerance=1e-3,
            prior_sigma=0.1,
            is_positive=True,
            one="scale",
            motion="drive further, and turn more, both ways",
        ),
    ),
}


def drive_names(kind: WheelKind) -> tuple[str, ...]:
    """Names of the drive parameters of a kind of wheels."""
    return tuple(spec.name for spec in DRIVES[kind])


GROUND_HEIGHT = ParameterSpec("ground_height", 1, "vector", "m", ("ground_height",), 5e-3, 0.1)

GroundPlane = Literal["floor", "level"]


@dataclass(frozen=True)
class Ground:
    """The ground: the floor that LiDARs see, or the horizontal plane through the origin of the world.

    tilt_noise: standard deviation of the tilt between wheel frame and plane, per keyframe and axis; None: the tilt is
    not constrained. height: height of the frame's origin over the plane. height_sigma: standard deviation of its
    constant error; None: the height is not constrained. bump_noise: standard deviation of the height per keyframe.
    """

    plane: GroundPlane
    tilt_noise: float | None = None  # rad
    height: float = 0.0  # m
    height_sigma: float | None = None  # m
    bump_noise: float = 3e-3  # m


NO_SIDEWAYS = (
    "icalib has no model of mecanum and omni wheels; give their nav_msgs/Odometry as a sensor of type: pose, "
    "kind: relative"
)
_WORDS = (
    "path", "topic", "drive", "measures", "sampling", "counts_per_turn", "counter_size", "angle_range", "rate_unit",
    "signs", "joints", "factor",
)  # fmt: skip
_NOISES = ("wheel_noise", "speed_noise", "yaw_noise", "steering_noise")
_GROUND = ("tilt_noise", "height", "height_sigma", "bump_noise")
_SLIP = ("lateral_slip", "vertical_slip")
_TURNED = ("rates", "angles", "ticks")
# Fields that are valid for some values of `measures` only.
_ONLY_OF: dict[str, tuple[str, ...]] = {
    "sampling": ("rates", "twist"), "counts_per_turn": ("ticks",), "counter_size": ("ticks",), "joints": _TURNED,
    "angle_range": ("angles",), "rate_unit": ("rates",), "signs": (*_TURNED, "twist"),
}  # fmt: skip
# Fields that are valid for some kinds of wheels only.
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


@dataclass(frozen=True)
class Wheels(MountedSensor):
    """The odometry of one set of wheels. Frame: x forward, y to the left, z up; the origin is midway between the wheels
    of the axle that is not steered.

    drive: differential (two driven wheels on one axle), skid-steer (both wheels of a side turn at the same rate) or
    ackermann (the front wheels steer). measures: rates [rad/s], angles turned [rad], encoder counts (ticks), relative
    planar poses (tables only), or twist: forward speed [m/s] and yaw rate [rad/s]. sampling: for rates and twist, see
    `WheelStream`. Noise densities: angle of each wheel, speed, yaw rate, steering angle, lateral and vertical slip.
    """

    sensor_type: ClassVar[str] = "wheels"
    noun: ClassVar[str] = "wheels"
    readings: ClassVar[str] = "readings"
    drives: ClassVar[bool] = True
    parameters: ClassVar[tuple[ParameterSpec, ...]] = (
        *MOUNTED,
        CLOCK_RATE,
        GROUND_HEIGHT,
        *(spec for drive in DRIVES.values() for spec in drive),
    )

    path: str
    drive: WheelDrive = "differential"
    radii: Parameter = Parameter()  # (2,) left, right [m]
    baseline: Parameter = Parameter()  # (1,) distance between the wheels [m]; for skid-steer the effective distance
    radius: Parameter = Parameter()  # (1,) of the driven wheel of ackermann [m]
    wheelbase: Parameter = Parameter()  # (1,) from rear to front axle [m]
    steering_offset: Parameter = Parameter()  # (1,) added to the steering angle [rad]
    scales: Parameter = Parameter()  # (2,) factors of speed and yaw rate
    wheel_noise: float = 0.03  # rad/sqrt(s): 0.25 rad/s for each rate at 70 Hz, the noise of simulated wheels
    speed_noise: float = 2e-3  # m/sqrt(s)
    yaw_noise: float = 1e-2  # rad/sqrt(s)
    steering_noise: float = 1e-3  # rad/sqrt(Hz): half a degree for each angle at 70 Hz
    lateral_slip: float = 5e-3  # m/sqrt(s)
    vertical_slip: float = 5e-3  # m/sqrt(s), off the ground
    factor: WheelFactor = "increments"  # relative-poses: equation (27) of the iCalib paper
    measures: WheelMeasure = "rates"
    sampling: Sampling = "interval-mean"
    counts_per_turn: float | None = None  # ticks per turn of the wheel
    signs: tuple[int, ...] | None = None  # 1 or -1 for each column of the table or each joint; None: all 1
    rate_unit: RateUnit = "rad/s"  # unit of rates
    angle_range: float | None = None  # wrap-around of angles [rad]; None: none, or found from the data
    counter_size: int | None = None  # encoder wrap-around [ticks]; None: none
    topic: str | None = None  # topic of the messages; None: the one with the name of the wheels, or the only one
    joints: tuple[str, ...] | None = None  # in JointState; None: found by "left" and "right" in the names
    ground: Ground | None = None
    layout: TableLayout = PLAIN_TABLE

    def __post_init__(self) -> None:
        check_sizes(self, self.stated())  # also those of other drives

    def specs(self) -> tuple[ParameterSpec, ...]:
        """See `Sensor`: extrinsics, time offset, clock rate, drive parameters, and the height if it is
        estimated."""
        return (*MOUNTED, CLOCK_RATE, *((GROUND_HEIGHT,) if self.knows_height else ()), *self.drive_specs)

    def is_estimated(self, spec: ParameterSpec) -> bool:
        """See `Sensor`; drive parameters are not estimated from relative poses, which do not depend on them."""
        return super().is_estimated(spec) and (self.measures != "poses" or spec not in self.drive_specs)

    @property
    def ground_height(self) -> Parameter:
        """Initial guess of the height over the ground [m], if it is estimated."""
        return Parameter("free", np.array([0.0 if self.ground is None else self.ground.height]))

    @property
    def kind(self) -> WheelKind:
        """The kind of wheels, key of `DRIVES`."""
        if self.measures == "twist":
            return "twist"
        return "steered" if self.drive == "ackermann" else "pair"

    @property
    def drive_specs(self) -> tuple[ParameterSpec, ...]:
        """The drive parameters: those besides extrinsics, time offset and height."""
        return DRIVES[self.kind]

    @property
    def may_change(self) -> tuple[tuple[str, ...], ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """See `Sensor`: also the size of wheels, as that of tyres with their load and air."""
        return (*MountedSensor.may_change, (self.drive_specs[0].name,))

    @property
    def knows_height(self) -> bool:
        """Whether `ground_height` is estimated."""
        return self.ground is not None and self.ground.height_sigma is not None

    @property
    def stays_level(self) -> bool:
        return self.ground is not None and self.ground.plane == "level" and self.ground.tilt_noise is not None

    @classmethod
    def parse(cls, name: str, value: YamlValue) -> Wheels:
        fields = value.record(
            ("type",),
            (*_WORDS, "ground", *_NOISES, *_SLIP, *TABLE, *parameter_fields(cls)),
        )
        measures: WheelMeasure = choice_or(fields, "measures", WheelMeasure, cls.measures)
        if "drive" in fields and fields["drive"].text() in ("mecanum", "omni", "omnidirectional", "holonomic"):
            fields["drive"].fail(f"{NO_SIDEWAYS}.")
        drive: WheelDrive = choice_or(fields, "drive", WheelDrive, cls.drive)
        bare = cls(name, "", drive, measures=measures)
        _refuse_other_measures(value, fields, bare)
        groups = parameters(fields, bare.specs())
        _refuse_negative_lengths(fields, groups, bare)
        given: dict[str, Any] = {d: positive_or(fields, d, getattr(cls, d)) for d in (*_NOISES, *_SLIP)}
        given |= groups
        return cls(
            name=name,
            path=path_or(fields, f"{name}/{measures}.csv"),
            drive=drive,
            factor=choice_or(fields, "factor", WheelFactor, "relative-poses" if measures == "poses" else cls.factor),
            measures=measures,
            sampling=choice_or(fields, "sampling", Sampling, cls.sampling),
            counts_per_turn=fields["counts_per_turn"].positive() if "counts_per_turn" in fields else None,
            counter_size=fields["counter_size"].whole(2) if "counter_size" in fields else None,
            angle_range=fields["angle_range"].positive() if "angle_range" in fields else None,
            rate_unit=choice_or(fields, "rate_unit", RateUnit, cls.rate_unit),
            signs=_signs(fields["signs"], drive) if "signs" in fields else None,
            topic=topic_or_none(fields),
            joints=_joints(fields["joints"], drive) if "joints" in fields else None,
            ground=_ground(fields["ground"]) if "ground" in fields else None,
            layout=table_layout(fields),
            **given,
        )

    def plain(self) -> dict[str, Any]:
        noises = [name for name in _NOISES if self.kind in _ONLY_OF_KIND[name]]
        same = ("path", "drive", "measures", "factor", *noises, *_SLIP)
        plain: dict[str, Any] = {"type": "wheels", **{name: getattr(self, name) for name in same}}
        given = {name: getattr(self, name) for name, of in _ONLY_OF.items() if self.measures in of}
        given |= layout_to_plain(self.layout)
        given["ground"] = None if self.ground is None else _ground_to_plain(self.ground)
        lists = {name: getattr(self, name) for name in ("joints", "signs")}
        given |= {"topic": self.topic, **{name: None if x is None else list(x) for name, x in lists.items()}}
        foreign = {spec.name for spec in self.parameters} - {spec.name for spec in self.specs()}
        groups = {name: p for name, p in groups_to_plain(self).items() if name not in foreign}
        return plain | {name: value for name, value in given.items() if value is not None} | groups

    def lacks(self, sensors: Mapping[str, Sensor], has_target: bool) -> Iterator[Lack]:
        yield from super().lacks(sensors, has_target)
        if self.ground is None:
            return
        if self.ground.plane == "floor" and not any(s.shows_planes for s in sensors.values()):
            yield Lack(
                ("sensors", self.name, "ground", "plane"),
                "a LiDAR determines the floor, and there is none; write level.",
            )
        if self.ground.plane == "level" and self.knows_height and not has_target:
            yield Lack(
                ("sensors", self.name, "ground", "height_sigma"),
                "the height is relative to the target, and there is none; remove it, or with a LiDAR write "
                "plane: floor.",
            )


def _refuse_other_measures(value: YamlValue, fields: dict[str, YamlValue], bare: Wheels) -> None:
    """Raises RigError if a field is not valid for `measures` or `drive`, or is missing."""
    for name, measures in _ONLY_OF.items():
        if name in fields and bare.measures not in measures:
            fields[name].fail(
                f"belongs to wheels that measure {' or '.join(measures)}, not {bare.measures}; remove it, or correct "
                "measures."
            )
    if bare.measures == "ticks" and "counts_per_turn" not in fields:
        value.fail(
            "counts_per_turn is missing; add the number of ticks per turn of the wheel, including the gear ratio."
        )
    if bare.drive != "differential" and bare.measures not in _TURNED:
        fields["drive"].fail(f"goes with wheels that measure {' or '.join(_TURNED)}; remove it, or correct measures.")
    for name, kinds in _ONLY_OF_KIND.items():
        if name in fields and bare.kind not in kinds:
            fields[name].fail(
                f"belongs to wheels with {' or '.join(_CALLED[k] for k in kinds)}; remove it, or correct drive and "
                "measures."
            )
    _refuse_factor(fields, bare)


def _refuse_factor(fields: dict[str, YamlValue], bare: Wheels) -> None:
    given = fields["factor"].text() if "factor" in fields else None
    if bare.measures == "poses" and given == "increments":
        fields["factor"].fail("relative poses have no increments of wheels; write relative-poses.")
    if bare.kind != "pair" and given == "relative-poses":
        fields["factor"].fail("relative-poses (the paper's factor) needs a left and a right wheel; write increments.")


def _refuse_negative_lengths(fields: dict[str, YamlValue], groups: dict[str, Any], bare: Wheels) -> None:
    for spec in bare.drive_specs:
        value = groups[spec.name].value if spec.name in groups else None
        if spec.is_positive and value is not None and (value <= 0).any():
            unit = "is in metres and" if spec.unit == "m" else "are factors and"
            fields[spec.name].fail(f"{unit} must be above 0; correct it.")


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
    fields = value.record(("plane",), _GROUND)
    if "tilt_noise" not in fields and "height_sigma" not in fields:
        value.fail("has no effect; add tilt_noise (rad), or height and height_sigma (m), or both.")
    for name in ("height", "bump_noise"):
        if name in fields and "height_sigma" not in fields:
            fields[name].fail("needs height_sigma, the uncertainty of the height (m); add it.")
    return Ground(
        choice_or(fields, "plane", GroundPlane, "level"),
        tilt_noise=fields["tilt_noise"].positive() if "tilt_noise" in fields else None,
        height=fields["height"].number() if "height" in fields else Ground.height,
        height_sigma=fields["height_sigma"].positive() if "height_sigma" in fields else None,
        bump_noise=positive_or(fields, "bump_noise", Ground.bump_noise),
    )


def _ground_to_plain(ground: Ground) -> dict[str, Any]:
    fields = [name for name in _GROUND if name == "tilt_noise" or ground.height_sigma is not None]
    plain = {name: getattr(ground, name) for name in ("plane", *fields)}
    return {name: value for name, value in plain.items() if value is not None}
