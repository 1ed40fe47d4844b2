"""Settings of a robot's motion through a room, and of the points that its cameras track."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from icalib.errors import RigError

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
    """Motion of a robot through its room.

    free: smooth, in all six degrees of freedom. single-axis: as free, but with rotation about `axis_imu` only.
    recorded: along a spline through the poses in the file `path` (TUM or EuRoC), shifted so that the middle of its
    extent is above the middle of the room. The others are motions of a wheel frame on the floor, without lateral and
    vertical velocity. They are planar and ramps (curves, on the flat floor and on the room's hills), straight-line
    (back and forth without rotation), constant-velocity, arc (constant speed and yaw rate), spin (rotation on the spot,
    back and forth) and standing.

    sideslip_deg: largest angle between the wheel frame's x axis and its velocity, which oscillates at 0.5 to 2 Hz:
    lateral slip of the wheels.
    """

    kind: DriveKind = "free"
    axis_imu: tuple[float, float, float] = (0.0, 0.0, 1.0)
    path: Path | None = None
    sideslip_deg: float = 0.0
    seed: int | None = None  # of the motion; None: the seed of the simulation

    def __post_init__(self) -> None:
        if (self.kind == "recorded") != (self.path is not None):
            raise RigError("a recorded motion needs a path, and only a recorded one; correct the motion.")

    @property
    def on_ground(self) -> bool:
        """Whether it is a motion of a wheel frame on the floor."""
        return self.kind in GROUND


@dataclass(frozen=True)
class Features:
    """Points on the room's surfaces, and settings of the front end that tracks them.

    The first `persistent` of `count` points keep their feature number. Other points get a new number if no camera saw
    them for 1.5 periods of the slowest camera, or after longest_track_s. A camera tracks at most per_image points, none
    further away than range_m [m]. seed: of the points, independent of the seed of the simulation. relief_m: standard
    deviation of their distance from the surfaces.
    """

    count: int = 1500
    persistent: int = 0
    longest_track_s: float = 5.0
    per_image: int = 100
    range_m: float = 15.0
    seed: int = 0
    relief_m: float = 0.0
