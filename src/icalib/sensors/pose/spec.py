"""A pose sensor of the rig (motion capture, or the odometry of another program), and its fields in the rig file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.sensors.fields import (
    TABLE,
    axes_or_none,
    choice_or,
    groups_to_plain,
    layout_to_plain,
    parameter_fields,
    parameters,
    path_or,
    table_layout,
    topic_or_none,
)
from icalib.sensors.parameter import AXES, Parameter, ParameterSpec
from icalib.sensors.sensor import (
    CLOCK_RATE,
    MOUNTED,
    PLAIN_TABLE,
    Axes,
    Lack,
    MountedSensor,
    Sensor,
    TableLayout,
    has_imu,
)

PoseKind = Literal["absolute", "relative"]
LengthUnit = Literal["m", "cm", "mm"]
METRES: dict[LengthUnit, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
# Three numbers of a rotation: a rotation vector, or angles about fixed (lower case) or turning axes (capitals).
THREE_NUMBERS = (
    "vector",
    *(axes for order in ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "zyz") for axes in (order, order.upper())),
)
_ROTATIONS = (
    "xyzw",
    "wxyz",
    "matrix",
    *(f"{name}, {unit}" for name in THREE_NUMBERS for unit in ("degrees", "radians")),
)
POSE_SCALE = ParameterSpec("scale", 1, "nuisance", "", ("scale",), 1e-2, 0.1)  # ratio of true to reported lengths
# Measured positions are those of the model, turned by this rotation vector: absolute ones in the frame, about its
# origin, displacements in the axes of the sensor.
POSITION_ROTATION = ParameterSpec(
    name="position_rotation",
    size=3,
    manifold="nuisance",
    unit="rad",
    labels=AXES,
    tolerance="rotation_tolerance_deg",
    prior_sigma=0.1,
    is_auxiliary=True,
    is_effect=True,
    largest=np.pi,
    meaning="rotation of its positions against its rotations",
)
_FIELDS = (
    "path",
    "topic",
    "kind",
    "level",
    "position_axes",
    "position_unit",
    "rotations",
    "inverted",
    "frames",
    "scale_sigma",
)
_NOISE = ("rotation_noise", "position_noise")


@dataclass(frozen=True)
class PoseSensor(MountedSensor):
    """A sensor that reports poses: motion capture, or the odometry of another program.

    absolute: poses are in a static frame whose pose in the world is estimated; the noise is white [rad, m]. relative:
    only the motion between successive poses is used; the noise is a random walk [rad/sqrt(s), m/sqrt(s)]. level: the z
    axis of the static frame points up. It is used if neither IMU nor target gives the vertical, unless the motion
    contradicts it.
    """

    sensor_type: ClassVar[str] = "pose"
    noun: ClassVar[str] = "pose sensor"
    readings: ClassVar[str] = "poses"
    gives_motion: ClassVar[bool] = True
    parameters: ClassVar[tuple[ParameterSpec, ...]] = (*MOUNTED, CLOCK_RATE, POSE_SCALE, POSITION_ROTATION)

    path: str
    kind: PoseKind = "absolute"
    rotation_noise: float | None = None  # on each axis; None: estimated from the residuals (position_noise likewise)
    position_noise: float | None = None
    level: bool = True
    position_axes: Axes | None = None  # recorded columns, with signs, that are x, y, z in the frame of the rotations
    position_unit: LengthUnit = "m"
    rotations: str | None = None  # how a table writes them, one of _ROTATIONS; None: quaternions x, y, z, w, or by name
    topic: str | None = None  # topic of the poses; None: the topic with the sensor's name, or the only one
    layout: TableLayout = PLAIN_TABLE
    inverted: bool = False  # whether the recorded poses are T_sensor_frame instead of T_frame_sensor
    frames: tuple[str, str] | None = None  # parent and child in a topic of transforms; None: the topic contains poses
    position_rotation: Parameter = Parameter("fixed")
    scale_sigma: float = 0.001  # prior standard deviation of scale; 0: scale is fixed at 1

    @property
    def scale(self) -> Parameter:
        """Ratio of true to reported lengths, with its prior."""
        one = np.ones(1)
        return Parameter("prior", one, self.scale_sigma * one) if self.scale_sigma > 0.0 else Parameter("fixed", one)

    @classmethod
    def parse(cls, name: str, value: YamlValue) -> PoseSensor:
        fields = value.record(("type",), (*_FIELDS, *_NOISE, *TABLE, *parameter_fields(cls)))
        return cls(
            name=name,
            path=path_or(fields, f"{name}/poses.csv"),
            kind=choice_or(fields, "kind", PoseKind, cls.kind),
            position_axes=axes_or_none(fields, "position_axes"),
            position_unit=choice_or(fields, "position_unit", LengthUnit, cls.position_unit),
            rotations=_rotations(fields["rotations"]) if "rotations" in fields else None,
            level=fields["level"].boolean() if "level" in fields else cls.level,
            topic=topic_or_none(fields),
            rotation_noise=fields["rotation_noise"].positive() if "rotation_noise" in fields else None,
            position_noise=fields["position_noise"].positive() if "position_noise" in fields else None,
            inverted="inverted" in fields and fields["inverted"].boolean(),
            layout=table_layout(fields),
            scale_sigma=_scale_sigma(fields["scale_sigma"]) if "scale_sigma" in fields else cls.scale_sigma,
            frames=_frames(fields["frames"]) if "frames" in fields else None,
            **parameters(fields, cls.stated()),
        )

    def plain(self) -> dict[str, Any]:
        plain: dict[str, Any] = {"type": "pose", "path": self.path, "kind": self.kind, "level": self.level}
        plain["scale_sigma"] = self.scale_sigma
        plain |= layout_to_plain(self.layout)
        given = {name: getattr(self, name) for name in (*_NOISE, "topic")}
        axes, frames = self.position_axes, self.frames
        given |= {"inverted": self.inverted or None, "position_axes": None if axes is None else list(axes)}
        given |= {"position_unit": None if self.position_unit == "m" else self.position_unit}
        given["rotations"] = None if self.rotations is None else self.rotations.split(", ")
        given["frames"] = None if frames is None else list(frames)
        return plain | {name: value for name, value in given.items() if value is not None} | groups_to_plain(self)

    @property
    def has_frame(self) -> bool:
        """See `Sensor`: absolute poses are relative to a static frame."""
        return self.kind == "absolute"

    @property
    def has_level_frame(self) -> bool:
        return self.has_frame and self.level

    def gives_motion_without_imu(self, has_target: bool) -> bool:
        return True

    def lacks(self, sensors: Mapping[str, Sensor], has_target: bool) -> Iterator[Lack]:
        yield from super().lacks(sensors, has_target)
        first = next(s for s in sensors.values() if s.gives_motion_without_imu(has_target))
        if has_imu(sensors) or first.name != self.name:
            return
        if self.kind != "absolute":
            yield Lack(
                ("sensors", self.name),
                "without an IMU, a LiDAR, or a camera that sees a target, this sensor must determine the motion; write "
                "kind: absolute, or add one of them.",
            )
        if len(sensors) == 1:
            yield Lack(("sensors", self.name), "is the only sensor; add the sensors to calibrate it with.")


def _scale_sigma(value: YamlValue) -> float:
    """The prior standard deviation of scale. Raises RigError if it is not in [0, 1)."""
    if not 0.0 <= (sigma := value.number()) < 1.0:
        value.fail(f"is a share of all lengths between 0 (exact) and 1, but is {sigma:g}; write 0.001 for 0.1 %.")
    return sigma


def _rotations(value: YamlValue) -> str:
    """How a table writes rotations, one of _ROTATIONS. Raises RigError if it is none of them."""
    entries = [entry.text() for entry in value.items()] if value.is_list else value.text().split(",")
    if (written := ", ".join(entry.strip() for entry in entries)) not in _ROTATIONS:
        value.fail(
            "must be xyzw or wxyz (quaternions), matrix, or three numbers with their unit, as in [xyz, degrees] "
            "(angles about fixed axes), [ZYX, degrees] (about turning axes) or [vector, radians]; correct it."
        )
    return written


def _frames(value: YamlValue) -> tuple[str, str]:
    """Names of parent and child frame. Raises RigError if they are not two different names."""
    names = [entry.text() for entry in value.items()]
    if len(names) != 2 or names[0].lstrip("/") == names[1].lstrip("/"):
        value.fail("must name two frames, the parent and the child, as in [base_link, tool0]; correct it.")
    return names[0], names[1]
