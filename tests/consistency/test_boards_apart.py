"""Cameras that share no view, and no IMU: each sees a board of its own, and all boards are one rigid scene."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from icalib.errors import EstimationError
from icalib.geometry.targets import AprilGrid, Scene
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.tools.simulation import Scenario, Simulation, handheld, rig_for, simulate

BACK = np.eye(4)  # T_cam0_cam1: looks nearly the other way
BACK[:3, :3] = Rotation.from_euler("yx", [170.0, 8.0], degrees=True).as_matrix()
BACK[:3, 3] = [0.1, 0.02, -0.05]
DISTANCE_M = 0.8


def boards_apart(noiseless: bool = False, front: int = 1) -> Scenario:
    """Two cameras, waved between two walls, each with a grid before it; front: grids on the first wall."""
    base = handheld(5.0, noiseless=noiseless)
    cam0, cam1 = (replace(c, time_offset_s=0.0, rate_hz=5.0, phase_s=0.0) for c in base.cameras)
    cam1 = replace(cam1, T_imu_sensor=cam0.T_imu_sensor @ BACK)
    T_world_cam0 = base.T_world_board @ np.diag([1.0, -1.0, -1.0, 1.0])
    T_world_cam0[:3, 3] += DISTANCE_M * base.T_world_board[:3, 2]
    columns = 6 // front
    grids = [AprilGrid(6, columns, 0.088, 0.3, first_id=6 * columns * k) for k in range(front)]
    grids.append(AprilGrid(6, 6, 0.088, 0.3, first_id=36))
    shifts = [0.36 * (k - 0.5 * (front - 1)) for k in range(front)]
    poses = [_before(T_world_cam0, grid, shift) for grid, shift in zip(grids, shifts, strict=False)]
    poses.append(_before(T_world_cam0 @ BACK, grids[-1], 0.0))
    names = (*(f"front{k}" for k in range(front)), "back")
    scene = Scene(names, tuple(grids))
    return replace(base, cameras=(cam0, cam1), target=scene, T_world_bodies=np.stack(poses))


def _before(T_world_cam: np.ndarray, grid: AprilGrid, shift: float) -> np.ndarray:
    """T_world_board of a grid that faces a camera, its middle `shift` beside the camera's axis."""
    middle = 0.5 * (grid.points.min(axis=0) + grid.points.max(axis=0))
    T = T_world_cam @ np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] += DISTANCE_M * T_world_cam[:3, 2] + T[:3, :3] @ ([shift, 0.0, 0.0] - middle)
    return T


def calibrated(*simulations: Simulation, lens: Literal["free", "fixed"] = "free") -> Calibration:
    """From cameras alone, nothing known of how they stand."""
    rig = rig_for(simulations[0].scenario, intrinsics=lens, distortion=lens).with_(imu=None)
    seen = [replace(s.measurements.without("imu0"), name=f"run{k}") for k, s in enumerate(simulations)]
    return calibrate_measurements(rig, seen if len(seen) > 1 else seen[0])


def error(result: Calibration) -> np.ndarray:
    """(6,) of T_cam0_cam1: rotation [rad], translation [m]."""
    T = result.T_imu_sensor("cam1")
    turn = Rotation.from_matrix(BACK[:3, :3].T @ T[:3, :3]).as_rotvec()
    return np.concatenate([turn, T[:3, 3] - BACK[:3, 3]])


@pytest.mark.parametrize("front", [2, pytest.param(1, marks=pytest.mark.full)])
def test_noiseless_images_give_the_truth(front: int):
    simulation = simulate(boards_apart(noiseless=True, front=front), 1)
    boards = [np.unique(simulation.scenario.target.body[c.point]).tolist() for c in simulation.measurements.cameras]
    assert boards == [list(range(front)), [front]]
    result = calibrated(simulation, lens="free" if front == 1 else "fixed")
    assert result.converged and np.abs(error(result)).max() < 1e-8
    T = np.linalg.inv(simulation.truth.T_world_bodies[0]) @ simulation.truth.T_world_bodies[-1]
    found = np.linalg.inv(result.T_scene_body("front0")) @ result.T_scene_body("back")
    np.testing.assert_allclose(found, T, atol=1e-8)


@pytest.mark.full
def test_the_covariance_is_honest():
    squares = []
    for seed in range(6):
        result = calibrated(simulate(boards_apart(), seed))
        columns = [k for name in ("rotation", "translation") for k in result.group("cam1", name).columns or ()]
        e = error(result)
        squares.append(e @ np.linalg.solve(result.covariance[np.ix_(columns, columns)], e))
    low, high = chi2.ppf([0.0005, 0.9995], 36)
    assert low < sum(squares) < high


@pytest.mark.full
def test_two_recordings_tell_what_each_of_them_tells():
    one, two = (simulate(boards_apart(), seed) for seed in (1, 2))
    together, alone = calibrated(one, two), calibrated(one)
    spread = together.group("cam1", "translation").std / alone.group("cam1", "translation").std
    np.testing.assert_allclose(spread, np.sqrt(0.5), atol=0.2)


def test_turning_about_one_axis_leaves_the_distance_along_it_open():
    scenario = boards_apart()
    result = calibrated(simulate(replace(scenario, motion=replace(scenario.motion, kind="planar")), 1))
    assert "unobservable" in result.group("cam1", "translation").verdict
    assert set(result.group("cam1", "rotation").verdict) == {"determined"}
    assert any("cam1 translation" in words for words in result.unobservable)


def test_what_cannot_be_tied_is_said():
    scenario = boards_apart()
    cam0, cam1 = scenario.cameras
    late = replace(scenario, cameras=(cam0, replace(cam1, phase_s=0.05)))
    with pytest.raises(EstimationError, match="cam1 sees back only.*take images of all cameras at the same instants"):
        calibrated(simulate(late, 1))
    wrong = replace(scenario, cameras=(cam0, replace(cam1, clock_origin_ns=cam1.clock_origin_ns + 400_000_000)))
    with pytest.raises(EstimationError, match="cam0 and cam1 see different bodies .* do not move alike"):
        calibrated(simulate(wrong, 1))
    simulation = simulate(scenario, 1)
    with pytest.raises(EstimationError, match="cam1 sees back only.*calibrate the cameras without the IMU"):
        calibrate_measurements(rig_for(scenario, intrinsics="free", distortion="free"), simulation.measurements)
