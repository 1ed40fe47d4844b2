"""Exports a calibration to a format by its name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from icalib.base.suggestion import suggestion
from icalib.errors import CalibrationError
from icalib.export.autoware import autoware
from icalib.export.colmap import colmap
from icalib.export.common import Export, guesses, no_place_for, others
from icalib.export.kalibr import camchain, camchain_name, imu_yaml
from icalib.export.lidar_odometry import fast_lio, fast_livo2, lio_sam
from icalib.export.mins import mins
from icalib.export.names import FORMATS, FRAMED
from icalib.export.openvins import openvins
from icalib.export.orb_slam3 import orb_slam3
from icalib.export.plain import plain_json
from icalib.export.ros import camera_info, ros2_static
from icalib.export.urdf import updated_urdf, urdf
from icalib.export.vins_fusion import vins_fusion
from icalib.result import Calibration


def export(
    c: Calibration,
    to: str,
    frames: Mapping[str, str] | None = None,
    existing_urdf: Path | None = None,
    joints: Mapping[str, str] | None = None,
) -> Export:
    """Export `c` to the format `to`, one of FORMATS.

    frames: frame or link name by sensor, for sensors whose frame has another name (formats in FRAMED). existing_urdf:
    URDF file to update. joints: joint to change in that file by sensor, by default the one directly above the sensor's
    link. Raises CalibrationError if the calibration lacks what the format requires, or an option belongs to another
    format.
    """
    frames, joints = frames or {}, joints or {}
    _check(c, to, frames, joints, existing_urdf)
    match to:
        case "ros2-static":
            return ros2_static(c, frames)
        case "urdf":
            return urdf(c, frames) if existing_urdf is None else updated_urdf(c, existing_urdf, frames, joints)
        case "autoware":
            return autoware(c, frames)
        case _:
            return _PLAIN[to](c)


def kalibr(c: Calibration) -> Export:
    """Kalibr's camchain if there are cameras, and imu.yaml if there is an IMU."""
    sentences = no_place_for("Kalibr", others(c, *c.cameras)) + guesses(c, c.cameras)
    comments = "".join(f"# {sentence}\n" for sentence in sentences)
    files = {camchain_name(c): comments + camchain(c)} if c.cameras else {}
    if c.imu is not None:
        files["imu.yaml"] = imu_yaml(c)
    return Export(files, sentences)


def _check(
    c: Calibration, to: str, frames: Mapping[str, str], joints: Mapping[str, str], existing: Path | None
) -> None:
    """Raise CalibrationError if the format is unknown, an option does not belong to it, or a sensor is unknown."""
    if to not in FORMATS:
        raise CalibrationError(f"there is no format {to}; available are {', '.join(FORMATS)}.")
    if frames and to not in FRAMED:
        raise CalibrationError(f"--frame belongs to {', '.join(FRAMED)}; {to} names no frames, so leave it out.")
    if existing is not None and to != "urdf":
        raise CalibrationError(f"--urdf belongs to --to urdf, not to {to}; leave it out.")
    if joints and existing is None:
        raise CalibrationError("--joint names joints of an existing file; give it as --to urdf --urdf FILE.")
    known = list(dict.fromkeys([c.reference, *c.mounted]))
    for sensor in (*frames, *joints):
        if sensor not in known:
            near = suggestion(sensor, known)
            raise CalibrationError(f"there is no sensor {sensor}{near}; this calibration has {', '.join(known)}.")


_PLAIN: dict[str, Callable[[Calibration], Export]] = {
    "kalibr": kalibr,
    "openvins": openvins,
    "vins-fusion": vins_fusion,
    "orb-slam3": orb_slam3,
    "camera-info": camera_info,
    "mins": mins,
    "fast-lio": fast_lio,
    "fast-livo2": fast_livo2,
    "lio-sam": lio_sam,
    "colmap": colmap,
    "json": plain_json,
}
