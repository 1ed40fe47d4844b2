"""Checks that the sensors of a rig can be calibrated together: at least one must determine the motion of the rig."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.base.suggestion import suggestion
from icalib.errors import RigError
from icalib.rig.kinds import SENSOR_TYPES
from icalib.rig.rig import Rig
from icalib.sensors.sensor import TARGET_FRAME, Lack, has_imu


def lack_of(rig: Rig) -> Lack | None:
    """The first reason why the sensors of the rig cannot be calibrated together; None if they can."""
    return next(_lacks(rig), None)


def check_complete(rig: Rig) -> None:
    """Raises RigError if the sensors of the rig cannot be calibrated together (see `lack_of`)."""
    lack = lack_of(rig)
    if lack is None:
        return
    place = ".".join(lack.where[1:])
    raise RigError(f"{place}{':' * (len(lack.where) > 2)} {lack.sentence}" if place else lack.sentence)


def _lacks(rig: Rig) -> Iterator[Lack]:
    yield from _second_imu(rig)
    if rig.body and rig.body not in rig.sensors:
        near = suggestion(rig.body, rig.sensors)
        yield Lack(("body",), f"there is no sensor {rig.body}{near}; available are {', '.join(rig.sensors)}.")
    if not any(sensor.gives_motion for sensor in rig.mounted):
        yield Lack(("sensors",), _no_motion(rig))
    for sensor in rig.sensors.values():
        yield from sensor.lacks(rig.sensors, rig.has_target)
    yield from _unknown_frames(rig)
    if not has_imu(rig.sensors):
        yield from _clocks_without_reference(rig)
    plane_sensor = any(s.shows_planes for s in rig.mounted)
    if rig.settings.points_on_planes_m > 0.0 and not (plane_sensor and any(s.tracks_points for s in rig.mounted)):
        yield Lack(
            ("settings", "points_on_planes_m"),
            "needs a LiDAR that sees planes, and a camera with feature tracks; remove it.",
        )


def _second_imu(rig: Rig) -> Iterator[Lack]:
    """Each IMU after the first: the estimator integrates only one. No other check refuses a second IMU."""
    first, *surplus = [s.name for s in rig.sensors.values() if s.is_inertial] or [""]
    for name in surplus:
        yield Lack(("sensors", name), f"is a second IMU beside {first}; keep one, and calibrate once for each.")


def _unknown_frames(rig: Rig) -> Iterator[Lack]:
    """Sensors that report in the frame of another sensor or of the target, if that frame does not exist. A target of
    several bodies has no frame."""
    for sensor in rig.mounted:
        name, where = sensor.shared_frame, ("sensors", sensor.name, "frame")
        if name == TARGET_FRAME and len(rig.target.bodies) > 1:
            yield Lack(where, f"a target of {len(rig.target.bodies)} bodies has no frame of its own; write levelled.")
        frames = [TARGET_FRAME] * rig.has_target + [s.name for s in rig.mounted if s.has_frame]
        if name and name not in frames:
            valid = ("levelled", "tilted", *frames)
            sentence = f"there is no frame {name}{suggestion(name, valid)}; available are {', '.join(valid)}."
            yield Lack(where, sentence)


def _no_motion(rig: Rig) -> str:
    nouns = [kind.noun for kind in SENSOR_TYPES.values() if kind.gives_motion]
    names = " and ".join(s.name for s in (*rig.mounted, rig.imu) if s is not None)
    alone = f"{names} do not determine the motion, and " if rig.mounted else ""
    missing = f"no {', no '.join(nouns[:-1])} and no {nouns[-1]}"
    return f"{alone}there is {missing}; add one of them."


def _clocks_without_reference(rig: Rig) -> Iterator[Lack]:
    """Sensors with `clock_restarts` but without a time offset, for rigs without an IMU: all sensors of a rig with
    cameras only, and the reference sensor."""
    for sensor in rig.mounted:
        if not sensor.clock_restarts:
            continue
        where = ("sensors", sensor.name, "clock_restarts")
        if rig.cameras_alone:
            yield Lack(where, "cameras alone have no time offsets; remove it, or add a sensor of type: imu.")
        elif sensor.name == rig.reference:
            yield Lack(
                where,
                f"without an IMU the clock of {rig.reference} is the reference clock; set clock_restarts of the other "
                "sensors instead, or write false.",
            )
