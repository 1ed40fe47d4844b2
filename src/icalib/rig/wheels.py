"""Wheels: how they drive and report, what they stand on, and their sizes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from icalib.rig.parameter import Parameter, check_sizes
from icalib.rig.parameter_spec import ParameterSpec
from icalib.rig.sensor import MOUNTED, PLAIN_TABLE, Sensor, TableLayout

WheelFactor = Literal["increments", "relative-poses"]
WheelMeasure = Literal["rates", "angles", "ticks", "poses", "twist"]
WheelDrive = Literal["differential", "skid-steer", "ackermann"]
RateUnit = Literal["rad/s", "deg/s", "rpm"]
RATE_UNITS: dict[RateUnit, float] = {"rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": math.pi / 30.0}  # in rad/s
WheelKind = Literal["pair", "steered", "twist"]  # what the two columns of a `WheelStream` are

# The parameters of each kind of wheels beside pose and clock.
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
    """Names of the parameters of `DRIVES`."""
    return tuple(spec.name for spec in DRIVES[kind])


GROUND_HEIGHT = ParameterSpec("ground_height", 1, "vector", "m", ("ground_height",), 5e-3, 0.1)

GroundPlane = Literal["floor", "level"]


@dataclass(frozen=True)
class Ground:
    """What wheels stand on: the floor that LiDARs see, or a plane as level as the horizon through the world's origin.

    tilt_noise: of the wheels' frame on the plane, at each node, about each axis; None: it may be tilted anyhow. height:
    of the frame's origin over the plane, with height_sigma, the same error all the time; None: it is not known.
    bump_noise: of the height at each node.
    """

    plane: GroundPlane
    tilt_noise: float | None = None  # rad
    height: float = 0.0  # m
    height_sigma: float | None = None  # m
    bump_noise: float = 3e-3  # m


@dataclass(frozen=True)
class Wheels(Sensor):
    """What rolls on the ground. Its frame has x forward, y to the left, z up, its origin midway between the wheels of
    the axle that is not steered.

    drive: differential, two driven wheels of one axle; skid-steer, two pairs of which each turns alike; ackermann, the
    front wheels steer. measures: rates [rad/s], angles turned [rad], counts of encoders (ticks), relative planar poses
    (tables only), or twist, forward speed [m/s] and yaw rate [rad/s]. sampling: of rates and twist; see `WheelStream`.
    Densities: of each wheel's angle, of speed and yaw rate, of the steering angle, and of slip.
    """

    sensor_type: ClassVar[str] = "wheels"
    parameters: ClassVar[tuple[ParameterSpec, ...]] = (
        *MOUNTED,
        GROUND_HEIGHT,
        *(spec for drive in DRIVES.values() for spec in drive),
    )

    path: str
    drive: WheelDrive = "differential"
    rotation: Parameter = Parameter()
    translation: Parameter = Parameter()
    time_offset: Parameter = Parameter()
    clock_restarts: bool = False  # from recording to recording: each has a time offset of its own
    radii: Parameter = Parameter()  # (2,) left, right [m]
    baseline: Parameter = Parameter()  # (1,) between the wheels [m]; of skid-steer the effective one
    radius: Parameter = Parameter()  # (1,) of the driven wheel of ackermann [m]
    wheelbase: Parameter = Parameter()  # (1,) from rear to front axle [m]
    steering_offset: Parameter = Parameter()  # (1,) what to add to the steering angle [rad]
    scales: Parameter = Parameter()  # (2,) what to multiply speed and yaw rate by
    wheel_noise: float = 0.03  # rad/sqrt(s): of rates at 70 Hz 0.25 rad/s each, as simulated wheels have it
    speed_noise: float = 2e-3  # m/sqrt(s)
    yaw_noise: float = 1e-2  # rad/sqrt(s)
    steering_noise: float = 1e-3  # rad/sqrt(Hz): of angles at 70 Hz half a degree each
    lateral_slip: float = 5e-3  # m/sqrt(s)
    vertical_slip: float = 5e-3  # m/sqrt(s), off the ground
    factor: WheelFactor = "increments"  # relative-poses: the paper's (27)
    measures: WheelMeasure = "rates"
    sampling: Literal["interval-mean", "instantaneous"] = "interval-mean"
    counts_per_turn: float | None = None  # of ticks, for one turn of the wheel
    signs: tuple[int, ...] | None = None  # 1 or -1 of each column of its table, or each joint; None: all 1
    rate_unit: RateUnit = "rad/s"  # of rates
    angle_range: float | None = None  # angles [rad] start anew after so much; None: never, or where it is plain
    counter_size: int | None = None  # the counters go back to zero after so many ticks; None: never
    topic: str | None = None  # of its messages; None: the one with the wheels' name, or the only one
    joints: tuple[str, ...] | None = None  # in JointState; None: told by "left" and "right" in the names
    ground: Ground | None = None
    layout: TableLayout = PLAIN_TABLE

    def __post_init__(self) -> None:
        check_sizes(self, self.stated())  # those of other drives, too

    def specs(self) -> tuple[ParameterSpec, ...]:
        """As in `Sensor`: those of its drive, and the height where that is estimated."""
        return (*MOUNTED, *((GROUND_HEIGHT,) if self.knows_height else ()), *self.drive_specs)

    def is_estimated(self, spec: ParameterSpec) -> bool:
        """As in `Sensor`; relative poses do not depend on the drive."""
        return super().is_estimated(spec) and (self.measures != "poses" or spec not in self.drive_specs)

    @property
    def ground_height(self) -> Parameter:
        """What the height over the ground starts from, where it is estimated."""
        return Parameter("free", np.array([0.0 if self.ground is None else self.ground.height]))

    @property
    def kind(self) -> WheelKind:
        """Which parameters it has: see `DRIVES`."""
        if self.measures == "twist":
            return "twist"
        return "steered" if self.drive == "ackermann" else "pair"

    @property
    def drive_specs(self) -> tuple[ParameterSpec, ...]:
        """Its parameters beside pose, clock and height."""
        return DRIVES[self.kind]

    @property
    def knows_height(self) -> bool:
        """Whether `ground_height` is estimated."""
        return self.ground is not None and self.ground.height_sigma is not None
