"""Names of the export formats. They are separate from the exporters, so that the command line imports them quickly.

Export to plain JSON: poses as matrices and quaternions, with standard deviations and verdicts.

Exports a calibration to a format by its name.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from icalib.base.files import printable, refuse_foreign, sealed_texts, write_texts
from icalib.base.suggestion import suggestion
from icalib.errors import CalibrationError
from icalib.export.colmap import colmap
from icalib.export.common import Export, guessed_poses, guesses, no_place_for, others, quaternion
from icalib.export.kalibr import camchain, camchain_name, imu_yaml
from icalib.export.lidar_odometry import fast_lio, fast_livo2, lio_sam
from icalib.export.openvins import mins, openvins
from icalib.export.orb_slam3 import orb_slam3
from icalib.export.ros import autoware, camera_info, ros2_static
from icalib.export.urdf import updated_urdf, urdf
from icalib.export.vins_fusion import vins_fusion
from icalib.result import Calibration
from icalib.result.summary import body_name, calibration_yaml, pose_key, reference_name

FORMATS = (
    "kalibr",
    "openvins",
    "vins-fusion",
    "orb-slam3",
    "ros2-static",
    "camera-info",
    "urdf",
    "autoware",
    "mins",
    "fast-lio",
    "fast-livo2",
    "lio-sam",
    "colmap",
    "json",
)
FRAMED = ("ros2-static", "urdf", "autoware")  # formats that contain names of sensor frames
ONE_FILE = ("ros2-static", "urdf", "json")  # formats whose output path is a file, not a folder


def plain_json(c: Calibration) -> Export:
    """The file calibration.json: the content of calibration.yaml, with a quaternion and a translation for each
    sensor."""
    body, key = body_name(c), pose_key(c)
    data: dict[str, Any] = {
        "conventions": {
            key: f"p_{body} = {key} p_sensor, 4 x 4, m",
            "quaternion_xyzw": f"the rotation of {key}",
            "translation": f"the sensor's origin in the {body} frame, m",
            "time_offset": f"t_{reference_name(c)} = t_sensor + time_offset, s",
            "std": f"rotation about the sensor's axes, rad; translation along those of {body}, m",
            "relative": "T_a_b takes coordinates in the frame of b to that of a",
        }
    }
    data |= yaml.safe_load(calibration_yaml(c))
    for sensor in data["sensors"].values():
        T = np.array(sensor[key])
        sensor |= {"quaternion_xyzw": list(quaternion(T[:3, :3])), "translation": T[:3, 3].tolist()}
    return Export(
        {"calibration.json": printable(json.dumps(data, indent=1, ensure_ascii=False)) + "\n"}, guessed_poses(c)
    )


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


def write_export(c: Calibration, to: str, folder: str | Path) -> tuple[str, ...]:
    """Writes the files of `export` into `folder`. Returns sentences on what the format cannot hold.

    Raises CalibrationError as `export`, and if `folder` cannot be written, or has files of these names that icalib did
    not write.
    """
    exported, place = export(c, to), Path(folder)
    refuse_foreign(place / name for name in exported.files)
    write_texts(place, sealed_texts(exported.files))
    return tuple(exported.sentences)


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
