"""Whether the sensors of a rig can be calibrated together: something must show the motion."""

from __future__ import annotations

from dataclasses import dataclass

from icalib.errors import RigError
from icalib.rig import Rig


@dataclass(frozen=True)
class Lack:
    """Why a rig cannot be calibrated, about the sensor of this name, or about all where it is empty."""

    sensor: str
    sentence: str


def lack_of(rig: Rig) -> Lack | None:
    """What keeps the sensors of the rig from being calibrated together; None where nothing does."""
    if not rig.cameras and not rig.lidars and not rig.poses:
        there = " and ".join([w.name for w in rig.wheels] + ([rig.imu.name] if rig.imu else []))
        alone = f"{there} do not determine the motion, and " if rig.wheels else ""
        return Lack("", f"{alone}there is no camera, no LiDAR and no pose sensor; add one of them.")
    if rig.imu is not None:
        return None
    if rig.lidars:
        return Lack(rig.lidars[0].name, "needs an IMU; add a sensor of type: imu, or remove this one.")
    if not rig.moves_by_poses:
        return None
    first = rig.poses[0]
    if first.kind != "absolute":
        return Lack(
            first.name,
            "without camera and IMU this sensor must determine the motion; write kind: absolute, or add one."
            if not rig.cameras else
            "without target and IMU this sensor must determine the motion; write kind: absolute, or add one."
        )  # fmt: skip
    if len(rig.poses) == 1 and not (rig.wheels or rig.cameras):
        return Lack(first.name, "is the only sensor; add the sensors to calibrate it with.")
    return None


def check_complete(rig: Rig) -> None:
    """Raises RigError where sensors cannot be calibrated together."""
    lack = lack_of(rig)
    if lack is not None:
        raise RigError(f"{lack.sensor} {lack.sentence}" if lack.sensor else lack.sentence)
