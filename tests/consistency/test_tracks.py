"""Cameras that follow points of the scene, without a target: truth recovered, and the covariance honest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.geometry.targets import NoTarget
from icalib.pipeline import calibrate_measurements
from icalib.rig import Parameter, Rig
from icalib.simulation import Scenario, load_scenario, rig_for, simulate

SCENARIO = Path(__file__).parents[2] / "examples" / "paper" / "table2-3d.yaml"


def table2(duration_s: float) -> Scenario:
    """IMU and three cameras of Table II that follow points of a room, alone."""
    return replace(load_scenario(SCENARIO), lidars=(), wheels=(), duration_s=duration_s)


def rig_of(scenario: Scenario, scale: float = 1.0) -> Rig:
    """No guess but intrinsics, focal lengths off by `scale`; the distortion free, from the truth."""
    rig = rig_for(scenario, intrinsics="start", distortion="start")
    cameras = []
    for camera in rig.cameras:
        guess = camera.intrinsics.value * np.array([scale, scale, 1.0, 1.0])
        cameras.append(replace(camera, intrinsics=Parameter("free", guess), track_noise_px=1.0))
    return replace(rig, target=NoTarget(), cameras=tuple(cameras))


def test_noiseless_tracks_are_recovered_from_nothing_but_rough_intrinsics():
    scenario = table2(12.0)
    scenario = replace(
        scenario, imu_noise_enabled=False, robot_noise_enabled=False, gyro_bias=(0.0,) * 3, accel_bias=(0.0,) * 3
    )
    simulation = simulate(scenario, 1)
    result = calibrate_measurements(rig_of(scenario, 1.03), simulation.measurements)
    assert result.converged, result.status
    for camera in scenario.cameras:
        T = camera.T_imu_cam
        turn = Rotation.from_matrix(T[:3, :3].T @ result.group(camera.name, "rotation").value)
        assert turn.magnitude() < 1e-7
        assert np.abs(result.group(camera.name, "translation").value - T[:3, 3]).max() < 1e-7
        offset = simulation.truth.time_offset[camera.name]
        assert abs(result.group(camera.name, "time_offset").value[0] - offset) < 1e-7
        assert result.group(camera.name, "intrinsics").value == pytest.approx(np.array(camera.intrinsics), rel=1e-7)


def check(consistency, duration_s: float, seeds: range, probability: float) -> None:
    scenario = table2(duration_s)
    found = consistency(scenario, rig_of(scenario, 1.02), seeds, probability)
    print({block: (round(c.nees, 3), round(c.low, 3), round(c.high, 3)) for block, c in found.items()})
    assert {block: c for block, c in found.items() if not c.consistent} == {}


def test_a_few_recordings(consistency):
    check(consistency, 6.0, range(4), 0.9999)


@pytest.mark.statistical
def test_many_recordings(consistency):
    check(consistency, 10.0, range(24), 0.99)
