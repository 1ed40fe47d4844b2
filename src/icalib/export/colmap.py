"""Export to COLMAP: `cameras.txt`, `rigs.txt` and `rig_config.json`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from icalib.export.common import (
    CameraParameters,
    Export,
    guesses,
    inverse,
    lens_of,
    need,
    no_place_for,
    others,
    quaternion,
    time_offsets,
)
from icalib.result import Calibration

# Name in COLMAP of each icalib camera model, and its number of coefficients; those without a counterpart are 0.
_MODELS = {
    "pinhole-radtan": ("OPENCV", 4),
    "pinhole-radtan5": ("FULL_OPENCV", 8),
    "pinhole-rational": ("FULL_OPENCV", 8),
    "pinhole-equidistant": ("OPENCV_FISHEYE", 4),
}
_CORNER = 0.5  # px: (0, 0) is the corner of the top-left pixel in COLMAP, and its centre in icalib


def colmap(c: Calibration) -> Export:
    """COLMAP files of all cameras, numbered from 1 in the order of the rig; the first is the rig frame. Raises
    CalibrationError without a camera."""
    need(c.cameras, "camera", "COLMAP")
    lenses = [lens_of(c, name, "COLMAP", tuple(_MODELS)) for name in c.cameras]
    imu = [] if c.imu is None else [c.imu]
    omissions = [*imu, *others(c, *c.cameras), *time_offsets(c, c.cameras)]
    sentences = tuple(lens.sentence for lens in lenses if lens.sentence) + no_place_for("COLMAP", omissions)
    sentences += guesses(c, c.cameras)
    first = inverse(c.T_imu_sensor(c.cameras[0]))
    poses = [inverse(first @ c.T_imu_sensor(name)) for name in c.cameras]  # T_cam_rig
    numbered = ", ".join(f"{i} is {name}" for i, name in enumerate(c.cameras, 1))
    comments = [f"For COLMAP, by icalib. {numbered}. Principal points count from the corner of the top-left pixel."]
    files = {
        "cameras.txt": _text(
            [*comments, *sentences, "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"],
            [[i, _MODELS[x.model][0], *x.resolution, *_params(x)] for i, x in enumerate(lenses, 1)],
        ),
        "rigs.txt": _text(
            [
                f"For COLMAP, by icalib. {numbered}. The rig's frame is that of {c.cameras[0]}: p_cam = T p_rig.",
                "RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (SENSOR_TYPE, SENSOR_ID, HAS_POSE, "
                "[QW, QX, QY, QZ, TX, TY, TZ])",
            ],
            [_rig(poses)],
        ),
        "rig_config.json": json.dumps([{"cameras": _config(c, lenses, poses)}], indent=1, ensure_ascii=False),
    }
    return Export(files, sentences)


def _params(lens: CameraParameters) -> list[float]:
    fx, fy, cx, cy = lens.intrinsics
    count = _MODELS[lens.model][1]
    return [fx, fy, cx + _CORNER, cy + _CORNER, *lens.distortion, *[0.0] * (count - len(lens.distortion))]


def _rig(poses: Sequence[np.ndarray]) -> list[Any]:
    row: list[Any] = [1, len(poses), "CAMERA", 1]
    for i, T in enumerate(poses[1:], 2):
        row += ["CAMERA", i, 1, *_wxyz(T), *T[:3, 3].tolist()]
    return row


def _config(c: Calibration, lenses: Sequence[CameraParameters], poses: Sequence[np.ndarray]) -> list[dict[str, Any]]:
    entries = []
    for i, (name, lens, T) in enumerate(zip(c.cameras, lenses, poses, strict=True)):
        pose = {"cam_from_rig_rotation": _wxyz(T), "cam_from_rig_translation": T[:3, 3].tolist()}
        entry = {"image_prefix": f"{name}/"} | (pose if i else {"ref_sensor": True})
        entries.append(entry | {"camera_model_name": _MODELS[lens.model][0], "camera_params": _params(lens)})
    return entries


def _wxyz(T: np.ndarray) -> list[float]:
    x, y, z, w = quaternion(T[:3, :3])
    return [w, x, y, z]


def _text(comments: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    lines = [f"# {comment}" for comment in comments]
    return "\n".join([*lines, *(" ".join(str(x) for x in row) for row in rows)]) + "\n"
