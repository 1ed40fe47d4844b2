"""The motion of a robot through a room, and the points that its cameras track."""

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
