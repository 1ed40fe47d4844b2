"""A standing car with three LiDARs in three scenes: poses of the side LiDARs in the frame of the top one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib import load_calibration
from icalib.cli import main

pytestmark = [pytest.mark.slow, pytest.mark.full]

# GICP scene by scene, which agrees to 0.3 deg and 2 cm: roll, pitch, yaw [deg] and translation [m].
REFERENCE = {
    "left": ((-4.2, 45.1, 92.1), (0.0, 0.57, -0.40)),
    "right": ((-0.5, 45.8, -86.4), (-0.04, -0.55, -0.43)),
}


@pytest.fixture(scope="module")
def result(three_lidars_car: Path, tmp_path_factory):
    """The calibration of the folder by `icalib inspect` and the draft that it writes."""
    folder = tmp_path_factory.mktemp("car")
    for scene in sorted(three_lidars_car.glob("*.npz")):
        arrays = np.load(scene)
        for name in ("top", "left", "right"):
            xyz = np.column_stack([arrays[name], np.zeros(len(arrays[name]))]).astype("<f4")
            path = folder / "clouds" / name / f"{scene.stem}.bin"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(xyz.tobytes())
    assert main(["inspect", str(folder / "clouds"), "--rig", str(folder / "rig.yaml"), "-q"]) == 0
    given = [str(folder / "rig.yaml"), str(folder / "clouds"), "-o", str(folder / "result"), "-q"]
    assert main(["calibrate", *given]) == 0
    return load_calibration(folder / "result")


@pytest.mark.parametrize("name", REFERENCE)
def test_side_lidars_are_where_others_found_them(result, name):
    poses = {s: np.eye(4) for s in ("left", "top", "right")}
    for sensor in ("top", "right"):
        poses[sensor][:3, :3] = result.group(sensor, "rotation").value
        poses[sensor][:3, 3] = result.group(sensor, "translation").value
    T = np.linalg.inv(poses["top"]) @ poses[name]
    euler, translation = REFERENCE[name]
    turn = Rotation.from_matrix(T[:3, :3]).inv() * Rotation.from_euler("xyz", euler, degrees=True)
    assert np.rad2deg(turn.magnitude()) < 0.5
    assert np.linalg.norm(T[:3, 3] - translation) < 0.03


def test_standard_deviations_are_of_the_size_of_the_errors(result):
    """The spread of three scenes is large; what is printed is neither a few millimetres nor decimetres."""
    std = result.group("top", "translation").std
    assert 3e-3 < np.linalg.norm(std) < 0.1
