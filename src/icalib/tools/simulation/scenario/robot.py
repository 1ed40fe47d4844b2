"""The true sensors of a robot beside its cameras and its IMU, and how it moves through a room."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from icalib.errors import RigError
from icalib.rig import WheelKind, drive_names

DriveKind = Literal[
    "free",
    "planar",
    "ramps",
    "single-axis",
    "constant-velocity",
    "straight-line",
    "standing",
    "arc",
    "spin",
    "recorded",
]
GROUND: tuple[DriveKind, ...] = (
    "planar",
    "ramps",
    "constant-velocity",
    "straight-line",
    "standing",
    "arc",
    "spin",
)


@dataclass(frozen=True)
class Drive:
    """How a robot moves through its room.

    free: smooth in all six directions. single-axis: as free, but turning about `axis_imu` only. recorded: along a
    spline through the poses in the file `path` (TUM or EuRoC), the middle of its extent moved above the middle of the
    room. All others are those of a wheel frame on the floor, which has no lateral and no vertical velocity: planar and
    ramps (curves, over the flat floor and over the room's hills), straight-line (back and forth without turning),
    constant-velocity, arc (constant speed and turning rate), spin (turning in place, to and fro) and standing.

    sideslip_deg turns a wheel frame on the floor out of the direction in which it moves, to and fro at 0.5 to 2 Hz by
    up to that angle: wheels that slide sideways.

    With `exact`, the true trajectory is the exact integral of body rates and specific forces that are constant between
    readings, the means of the two, steered along the closed form (of a wheel frame it keeps the wheels' law to the
    error of steering: it slides by up to 1 mm/s, 0.2 mm/s RMS); otherwise readings sample the closed form.
    """

    kind: DriveKind = "free"
    exact: bool = False
    axis_imu: tuple[float, float, float] = (0.0, 0.0, 1.0)
    path: Path | None = None
    sideslip_deg: float = 0.0
    seed: int | None = None  # None: drawn anew for each seed of the simulation

    def __post_init__(self) -> None:
        if (self.kind == "recorded") != (self.path is not None):
            raise RigError("a recorded motion needs a path, and only a recorded one; correct the motion.")

    @property
    def on_ground(self) -> bool:
        """Whether wheels that roll without slipping could do it."""
        return self.kind in GROUND


@dataclass(frozen=True)
class Features:
    """Points on the room's surfaces, and the front end that follows them.

    The first `persistent` of `count` points keep their number; any other has a new number when no camera saw it
    for 1.5 periods of the slowest camera, or after longest_track_s. A camera follows at most per_image points, none
    further away than range_m. The points are those of `seed`, whatever the seed of the simulation; they lie off their
    surfaces by relief_m (standard deviation).
    """

    count: int = 1500
    persistent: int = 0
    longest_track_s: float = 5.0
    per_image: int = 100
    range_m: float = 15.0
    seed: int = 0
    relief_m: float = 0.0


@dataclass(frozen=True, eq=False)
class SimLidar:
    """One true LiDAR that turns about its z axis, against the clock.

    Scan i begins at phase_s + i / rate_hz (IMU clock) and has azimuth_steps columns of `rings` points, at elevations
    spread evenly over elevation_deg. The lasers of a column fire one after another, 2.304 us apart, or closer where
    they would not fit. The scan is stamped at its first point; clocks as in `SimCamera`. Noise is along the beam.
    """

    name: str
    T_imu_lidar: np.ndarray  # (4, 4)
    time_offset_s: float = 0.0
    rate_hz: float = 8.0
    phase_s: float = 0.0
    clock_origin_ns: int = 0
    rings: int = 16
    azimuth_steps: int = 1800
    elevation_deg: tuple[float, float] = (-15.0, 15.0)
    range_m: tuple[float, float] = (0.3, 100.0)
    range_noise_m: float = 0.03


@dataclass(frozen=True, eq=False)
class SimWheels:
    """True wheels; their frame is the middle of the axle that is not steered, on the floor, x forwards, z up.

    radii (left, right) [m], baseline [m]. noise: density of each wheel's rate [rad/s/sqrt(Hz)]; slip: density of a
    lateral random path [m/sqrt(s)], in poses only. allowed_slip: density of slip [m/sqrt(s)] that the rig is told;
    encoders simulated here know none, while a rig that is told nothing allows for what real wheels may have.

    rates: what encoders report, by `sampling` as in `WheelStream`: (v_x -+ baseline/2 w_z) / radius. twist: forward
    speed and yaw rate, v_x and w_z over their scales, by `sampling`, too. steering: the rate v_x / radius of a driven
    wheel, and the angle by which front wheels a wheelbase ahead point to where they move, less steering_offset [rad].
    Raised as RigError by `Scenario` where the motion is not a wheel frame's. poses: relative poses as the paper's (27)
    predicts them from the truth, one for every `poses_every` readings, with the noise that integrating the readings
    would have.
    """

    name: str
    T_imu_wheel: np.ndarray  # (4, 4)
    radii: tuple[float, float] = (0.1, 0.1)
    baseline: float = 0.4
    time_offset_s: float = 0.0
    rate_hz: float = 70.0
    phase_s: float = 0.0
    clock_origin_ns: int = 0
    noise: float = 0.03
    slip: float = 0.0
    allowed_slip: float | None = None
    reports: Literal["rates", "twist", "steering", "poses"] = "rates"
    sampling: Literal["interval-mean", "instantaneous"] = "interval-mean"
    poses_every: int = 3
    scales: tuple[float, float] = (1.0, 1.0)
    speed_noise: float = 2e-3  # m/s/sqrt(Hz)
    yaw_noise: float = 1e-2  # rad/s/sqrt(Hz)
    radius: float = 0.1
    wheelbase: float = 0.6
    steering_offset: float = 0.0
    steering_noise: float = 1e-3  # rad/sqrt(Hz)

    @property
    def drive(self) -> dict[str, np.ndarray]:
        """Its parameters beside pose and clock, by the names of the rig's groups."""
        kinds: dict[str, WheelKind] = {"twist": "twist", "steering": "steered"}
        names = drive_names(kinds.get(self.reports, "pair"))
        return {name: np.atleast_1d(np.array(getattr(self, name))) for name in names}


@dataclass(frozen=True, eq=False)
class SimPoses:
    """One true sensor that reports its pose T_frame_sensor in a frame that stands at T_world_frame; clocks as in
    `SimCamera`.

    absolute: each pose has noise of its own, rotation_noise [rad] and position_noise [m] on each axis. relative: each
    step from pose to pose has, which adds up to a drift: rad/sqrt(s) and m/sqrt(s). scale: true lengths over reported
    ones.
    """

    name: str
    T_imu_sensor: np.ndarray  # (4, 4)
    kind: Literal["absolute", "relative"] = "absolute"
    T_world_frame: np.ndarray = field(default_factory=lambda: np.eye(4))
    time_offset_s: float = 0.0
    rate_hz: float = 100.0
    phase_s: float = 0.0
    clock_origin_ns: int = 0
    rotation_noise: float = 2e-3
    position_noise: float = 1e-3
    scale: float = 1.0
