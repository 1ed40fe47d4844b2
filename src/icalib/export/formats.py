"""Names of the export formats. They are separate from the exporters, so that the command line imports them quickly.

Export to plain JSON: poses as matrices and quaternions, with standard deviations and verdicts.

Exports a calibration to a format by its name.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from icalib.base.files import (
    check_writable,
    printable,
    refuse_foreign,
    refuse_foreign_set,
    sealed,
    sealed_texts,
    write_files,
    write_texts,
)
from icalib.base.yaml_nodes import suggestion
from icalib.errors import CalibrationError
from icalib.export.colmap import colmap
from icalib.export.common import Export, guessed_poses, guesses, imus, no_place_for, others, quaternion
from icalib.export.kalibr import camchain, camchain_name, imu_omissions, imu_yaml, kalibr_texts
from icalib.export.odometry import fast_lio, fast_livo2, lio_sam, mins, openvins, orb_slam3, vins_fusion
from icalib.export.ros import autoware, camera_info, ros2_static, updated_urdf, urdf
from icalib.report import report_html
from icalib.result import Calibration, calibration_files
from icalib.result.saving import body_name, calibration_yaml, pose_key, reference_name

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
    moving = {
        "clock_rate": "change of time_offset with t_sensor, ppm; time_offset is that of the middle of the recording",
        "readout": "from the first row to the one after the last, s; time_offset is that of the middle row",
    }
    data["conventions"] |= {name: moving[name] for name in moving if any(g.name == name for g in c.groups)}
    data |= yaml.safe_load(calibration_yaml(c))
    data |= {name: list(getattr(c, name)) for name in ("reasons", "unobservable", "warnings", "notes")}
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
    omissions = others(c, *c.cameras, *imus(c)[1:]) + imu_omissions(c)
    sentences = no_place_for("Kalibr", omissions) + guesses(c, c.cameras)
    chain = camchain(c) if c.cameras else ""
    comments = "".join(f"# {sentence}\n" for sentence in sentences if sentence not in chain)
    files = {camchain_name(c): comments + chain} if c.cameras else {}
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


# Output folder of a calibration: all files that derive from one result, written as one set.


def write_outputs(calibration: Calibration, folder: str | Path) -> None:
    """Write `output_files` into `folder`: all or none.

    Raises CalibrationError if `folder` cannot be written, or contains files of the same names that icalib did not
    write.
    """
    refuse_foreign_set(Path(folder))
    write_files(Path(folder), output_files(calibration))


def output_files(calibration: Calibration) -> dict[str, bytes]:
    """Contents of the result files, Kalibr's files (`kalibr_texts`) and the report, by name."""
    texts = {"report.html": report_html(calibration)}
    texts |= {name: text(calibration) for name, text in kalibr_texts(calibration).items()}
    return calibration_files(calibration) | {name: sealed(printable(text).encode()) for name, text in texts.items()}


def check_folder(folder: str | Path, inputs: Sequence[Path] = ()) -> None:
    """Create `folder` and check that it can be written, before the calibration starts.

    Raises CalibrationError if it cannot, or if a file that icalib did not write, or one of `inputs`, would be
    overwritten.
    """
    check_writable(Path(folder))
    refuse_foreign_set(Path(folder), inputs)
