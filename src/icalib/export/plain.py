"""Export to plain JSON: poses as matrices and quaternions, with standard deviations and verdicts."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import yaml

from icalib.base.text_files import printable
from icalib.export.common import Export, guessed_poses, quaternion
from icalib.result import Calibration
from icalib.result.summary import body_name, calibration_yaml, pose_key, reference_name


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
