"""Base classes of the sensors of a rig: `Sensor`, `ClockedSensor` with a time offset, `MountedSensor` with
extrinsics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal, Self, TypeVar

from icalib.base.yaml_nodes import YamlValue
from icalib.sensors.parameter import AXES, Parameter, ParameterSpec, check_sizes

T = TypeVar("T")
TimeUnit = Literal["s", "ms", "us", "ns"]
# A reading is a sample at its stamp, or the mean over the interval that ends there.
Sampling = Literal["interval-mean", "instantaneous"]
Axes = tuple[str, str, str]  # recorded columns that become x, y, z, with signs: ("x", "-y", "-z")

_PLACES = "show the target in more places, tilted about another axis at each"
ROTATION = ParameterSpec(
    name="rotation",
    size=3,
    manifold="rotation",
    unit="rad",
    labels=AXES,
    tolerance="rotation_tolerance_deg",
    prior_sigma=0.1,
    motion="turn the rig about {axes}",
    motion_on_wheels="drive over ramps: a flat floor does not show tilts; or give it as a prior",
    motion_at_rest=_PLACES,
)
TRANSLATION = ParameterSpec(
    name="translation",
    size=3,
    manifold="vector",
    unit="m",
    labels=AXES,
    tolerance="translation_tolerance_m",
    prior_sigma=0.1,
    motion="turn the rig briskly about {axes}: a lever arm shows only in rotation",
    motion_on_wheels="turn, and drive over ramps: a flat floor does not show heights; or give it as a prior",
    motion_at_rest=_PLACES,
)
TIME_OFFSET = ParameterSpec(
    name="time_offset",
    size=1,
    manifold="vector",
    unit="s",
    labels=("time_offset",),
    tolerance="time_tolerance_s",
    prior_sigma=0.02,
    motion="turn or shake the rig faster, so that a time shift shows",
    motion_on_wheels="speed up, brake and turn more",
)
# Rate of the reference clock against that of the sensor, less 1: t_reference = t + time_offset + rate (t - t_mid). At
# t_mid the reference clock is in the middle of its recording. By their data sheets, quartz oscillators are within
# 50 ppm.
CLOCK_RATE = ParameterSpec(
    name="clock_rate",
    size=1,
    manifold="nuisance",
    unit="ppm",
    labels=("clock_rate",),
    tolerance=10.0,
    prior_sigma=50.0,
    is_auxiliary=True,
    is_effect=True,
    largest=1e5,
    meaning="how much more time passes on the clock of the reference",
    motion="record longer",
)
MOUNTED = (ROTATION, TRANSLATION, TIME_OFFSET)  # parameters of every `MountedSensor`
MOUNTED_NAMES = tuple(spec.name for spec in MOUNTED)
TARGET_FRAME = "target"  # name of the target's frame in the rig file


def mounted(rotation: T, translation: T, time_offset: T) -> dict[str, T]:
    """The three values by the names of `MOUNTED`."""
    return dict(zip(MOUNTED_NAMES, (rotation, translation, time_offset), strict=True))


@dataclass(frozen=True)
class TableLayout:
    """The layout of a sensor's table.

    columns: header names, or column numbers from 1, of the columns in the order that icalib expects; empty: recognised
    by the header, or already in that order. time_unit: unit of the stamps; None: recognised by their rate.
    """

    columns: tuple[str, ...] = ()
    time_unit: TimeUnit | None = None


PLAIN_TABLE = TableLayout()


@dataclass(frozen=True)
class Lack:
    """A reason why the sensors of a rig cannot be calibrated together. where: path of the field in the rig file, from
    its root."""

    where: tuple[str, ...]
    sentence: str


@dataclass(frozen=True)
class Sensor:
    """A sensor of the rig.

    A kind of sensor declares these class variables. sensor_type: its `type` in the rig file and its folder in
    `icalib.sensors`. noun: its name in messages. readings: its measurements in messages, in the plural. parameters: all
    parameters that sensors of this kind can have. gives_motion: such a sensor and an IMU determine the motion of the
    rig. is_inertial: it is an IMU. shows_planes: it measures points on planes. sees_target: it measures points of the
    target. drives: the rig drives on it, so that it hardly tilts. lens: names of those of `parameters` that are its
    camera model, empty without one; its projection is what counts of them. may_change: groups of its parameters, by
    name, that may change together during a recording, as clocks drift and mounts move.
    """

    sensor_type: ClassVar[str]
    noun: ClassVar[str]
    readings: ClassVar[str] = "measurements"
    parameters: ClassVar[tuple[ParameterSpec, ...]]
    gives_motion: ClassVar[bool] = False
    is_inertial: ClassVar[bool] = False
    shows_planes: ClassVar[bool] = False
    sees_target: ClassVar[bool] = False
    drives: ClassVar[bool] = False
    lens: ClassVar[tuple[str, ...]] = ()
    may_change: ClassVar[tuple[tuple[str, ...], ...]] = ((TIME_OFFSET.name,), (ROTATION.name, TRANSLATION.name))
    clock_restarts = False  # a field of `ClockedSensor`
    name: str

    def __post_init__(self) -> None:
        check_sizes(self, self.specs())

    @classmethod
    def parse(cls, name: str, value: YamlValue) -> Sensor:
        """The sensor called `name` from its fields in the rig file. Raises RigError naming file, line and field."""
        raise NotImplementedError(cls)

    def plain(self) -> dict[str, Any]:
        """The fields of the rig file as lists, numbers and text, from which `parse` makes an equal sensor."""
        raise NotImplementedError(type(self))

    def specs(self) -> tuple[ParameterSpec, ...]:
        """The parameters that this sensor has, in the order of the layout."""
        return self.parameters

    def with_effects(self) -> Self:
        """This sensor with the effects that its `specs` have only on demand, each fixed at zero."""
        return self

    def spec(self, name: str) -> ParameterSpec:
        """The definition of the parameter group `name` for this sensor."""
        return next(spec for spec in (*self.specs(), *self.parameters) if spec.name == name)

    def is_estimated(self, spec: ParameterSpec) -> bool:
        """Whether the group is estimated according to this sensor; the rest of the rig may still prevent it."""
        return getattr(self, spec.name).mode != "fixed"

    def gives_motion_without_imu(self, has_target: bool) -> bool:
        """Whether this sensor alone determines the motion of the rig; has_target: the cameras of the rig see a
        target."""
        return False

    @property
    def has_frame(self) -> bool:
        """Whether the sensor reports in a static frame whose pose in the world is estimated, see `icalib.model`."""
        return False

    @property
    def has_level_frame(self) -> bool:
        """Whether z of its static frame points upwards or downwards."""
        return False

    @property
    def shared_frame(self) -> str:
        """Name of the sensor in whose frame this sensor reports, or `TARGET_FRAME`; empty if it shares no frame."""
        return ""

    @property
    def stays_level(self) -> bool:
        """Whether the sensor determines roll and pitch, because it stays parallel to the horizon."""
        return False

    @property
    def tracks_points(self) -> bool:
        """Whether the sensor has feature tracks."""
        return False

    def lacks(self, sensors: Mapping[str, Sensor], has_target: bool) -> Iterator[Lack]:
        """Yields what this sensor needs and the rig lacks: other sensors, or a target."""
        yield from ()

    @classmethod
    def stated(cls) -> tuple[ParameterSpec, ...]:
        """Those of `parameters` that have a field in the rig file."""
        names = {f.name for f in fields(cls)}
        return tuple(spec for spec in cls.parameters if spec.name in names)


@dataclass(frozen=True, kw_only=True)
class ClockedSensor(Sensor):
    """A sensor with a clock that differs from that of the reference sensor: t_reference = t + time_offset + clock_rate
    (t - t_mid), see `CLOCK_RATE`. Without a value the rate is zero. Where the time offset is fixed, so
    is the rate.

    clock_restarts: each recording has a separate time offset.
    """

    time_offset: Parameter = Parameter()
    clock_rate: Parameter = Parameter("fixed")
    clock_restarts: bool = False


@dataclass(frozen=True, kw_only=True)
class MountedSensor(ClockedSensor):
    """A sensor with extrinsics T_imu_sensor, constant: x_imu = R_imu_sensor x_sensor + p_imu_sensor.

    rotation (3, 3) is R_imu_sensor, translation (3,) is p_imu_sensor [m]. Without an IMU they are relative to
    `Rig.reference`.
    """

    parameters: ClassVar[tuple[ParameterSpec, ...]] = (*MOUNTED, CLOCK_RATE)

    rotation: Parameter = Parameter()
    translation: Parameter = Parameter()


def has_imu(sensors: Mapping[str, Sensor]) -> bool:
    """Whether one of the sensors is an IMU."""
    return any(sensor.is_inertial for sensor in sensors.values())
