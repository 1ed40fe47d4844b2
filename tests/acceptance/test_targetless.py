"""From raw images of a room without a target, and an IMU, to the calibration: nothing of the lens is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import icalib
from icalib.geometry import so3
from icalib.geometry.targets import NoTarget
from icalib.rig import Parameter, Settings
from icalib.tools.simulation import film, load_scenario, rig_for, write_film

PAPER = Path(__file__).parents[2] / "examples" / "paper"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """10 s of 320 x 240 px at 10 Hz, and what is true."""
    scenario = load_scenario(PAPER / "table2-3d.yaml")
    camera = replace(scenario.cameras[0], rate_hz=10.0, resolution=(320, 240), intrinsics=(195.2, 194.6, 156.3, 124.2))
    scenario = replace(
        scenario,
        cameras=(camera,),
        sensors=(),
        features=None,
        target=NoTarget(),
        T_world_bodies=np.zeros((0, 4, 4)),
        duration_s=10.0,
    )
    filmed, path = film(scenario, 3), tmp_path_factory.mktemp("room") / "room.bag"
    write_film(filmed, {"ros1": path})
    rig = rig_for(scenario, intrinsics="free", distortion="free")
    free = Parameter("free")
    camera = replace(
        rig.cameras[0], tracks="images", corner_noise_px=None, track_noise_px=None, intrinsics=free, distortion=free
    )
    return rig.with_(cameras=(camera,), settings=Settings()), path, filmed.truth


@pytest.mark.full
def test_a_camera_is_calibrated_from_raw_images_of_a_room(recorded, tmp_path, monkeypatch):
    monkeypatch.setenv("ICALIB_CACHE", str(tmp_path))
    rig, path, truth = recorded
    found = icalib.calibrate(rig, path)
    assert found.converged
    groups = {g.name: g for g in found.groups if g.sensor == "cam0"}
    T = truth.T_imu_sensor["cam0"]
    turn = so3.log(T[:3, :3].T @ groups["rotation"].value)
    errors = {
        "rotation": turn,
        "translation": groups["translation"].value - T[:3, 3],
        "time_offset": groups["time_offset"].value - truth.time_offset["cam0"],
        "intrinsics": groups["intrinsics"].value - truth.values["cam0"]["intrinsics"],
    }
    most = {"rotation": np.radians(0.1), "translation": 0.02, "time_offset": 2e-4, "intrinsics": 0.5}
    for name, error in errors.items():
        assert np.abs(error).max() < most[name], (name, error)
        assert np.abs(error / groups[name].std).max() < 4.0, (name, error, groups[name].std)
