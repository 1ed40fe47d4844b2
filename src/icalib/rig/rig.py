"""What is on the robot and what is to be calibrated: the rig."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from icalib.errors import RigError
from icalib.geometry.targets import NoTarget, Target
from icalib.rig.camera import Camera
from icalib.rig.imu import ImuSensor
from icalib.rig.lidar import Lidar
from icalib.rig.parameter import check_fields
from icalib.rig.pose import PoseSensor
from icalib.rig.settings import Settings
from icalib.rig.wheels import Wheels


@dataclass(frozen=True)
class Rig:
    """The whole robot. Without an IMU the frame of the first camera that sees a target is the body frame, or that of
    the first pose sensor. If cameras are all there is, time stands still: images taken at the same stamp are taken
    together, nothing ties one instant to the next; else the motion is assumed to be smooth. There may be no camera
    beside a pose sensor, or beside an IMU and a LiDAR."""

    imu: ImuSensor | None
    cameras: tuple[Camera, ...]
    target: Target = NoTarget()
    gravity: float = 9.81  # m/s^2
    settings: Settings = Settings()
    path: Path | None = None
    lidars: tuple[Lidar, ...] = ()
    wheels: tuple[Wheels, ...] = ()
    poses: tuple[PoseSensor, ...] = ()

    @property
    def has_target(self) -> bool:
        """Whether there is a target; else all cameras have feature tracks."""
        return len(self.target.bodies) > 0

    @property
    def blooms(self) -> bool:
        """Whether bloom is estimated: it is asked for, and the target's corners can be pulled."""
        return self.settings.bloom and self.target.blooms

    @property
    def body(self) -> str:
        """Name of the sensor whose frame is the body frame."""
        return self.first_seeing if self.imu is None else self.imu.name

    @property
    def first_seeing(self) -> str:
        """Name of the sensor that is the body where there is no IMU."""
        return (*self.poses, *self.cameras)[0].name if self.moves_by_poses else (*self.cameras, *self.poses)[0].name

    @property
    def moves_by_poses(self) -> bool:
        """Whether without an IMU the first pose sensor shows the motion: no camera sees a target."""
        return bool(self.poses) and not (self.cameras and self.has_target)

    @property
    def cameras_alone(self) -> bool:
        """Whether there are cameras and no other sensor."""
        return self.imu is None and not (self.lidars or self.wheels or self.poses)

    @property
    def assumes_motion(self) -> bool:
        """Whether an assumption stands in for the IMU."""
        return self.imu is not None and self.imu.assumed

    def with_(self, part: str = "", /, **fields: Any) -> Rig:
        """The same rig with some `fields` changed: of the sensor called `part`, of "settings", or of the rig itself.

        For example rig.with_("cam0", intrinsics=icalib.fixed([458, 457, 367, 248])). Raises RigError where there is
        no such sensor or field, or a value is of another kind.
        """
        places = {"": (None, self), "settings": ("settings", self.settings)}
        imus = {} if self.imu is None else {self.imu.name: ("imu", self.imu)}
        kinds = ("cameras", "lidars", "wheels", "poses")
        places |= imus | {s.name: (kind, s) for kind in kinds for s in getattr(self, kind)}
        if part not in places:
            raise RigError(f"there is no sensor {part}; the rig has {', '.join(filter(None, places))}.")
        kind, old = places[part]
        check_fields(part or "the rig", old, fields)
        new = dataclasses.replace(old, **fields)
        if kind is None:
            return new
        same = getattr(self, kind)
        changed = tuple(new if s is old else s for s in same) if isinstance(same, tuple) else new
        return dataclasses.replace(self, **{kind: changed})
