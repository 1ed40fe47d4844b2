"""The whole program on simulated recordings: truth recovered, noiseless to numerical precision."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.typed import not_none

from icalib.geometry.targets import Charuco, Checkerboard, Target
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter, Rig
from icalib.sensors.imu.spec import FREE
from icalib.tools.simulation import Scenario, Simulation, handheld, rig_for, simulate


def extrinsics_error(result: Calibration, simulation: Simulation, camera: str) -> tuple[float, float, float]:
    """rad, m, s."""
    T = simulation.truth.T_imu_sensor[camera]
    turn = Rotation.from_matrix(T[:3, :3].T @ result.group(camera, "rotation").value).magnitude()
    move = np.linalg.norm(result.group(camera, "translation").value - T[:3, 3])
    offset = result.group(camera, "time_offset").value[0] - simulation.truth.time_offset[camera]
    return turn, float(move), abs(float(offset))


@pytest.mark.parametrize("asynchronous", [False, True])
def test_noiseless_recordings_are_recovered_from_nothing(asynchronous: bool):
    simulation = simulate(handheld(20.0, asynchronous=asynchronous, noiseless=True), 0)
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free")
    result = calibrate_measurements(rig, simulation.measurements)
    assert result.converged, result.status
    for camera in ("cam0", "cam1"):
        assert max(extrinsics_error(result, simulation, camera)) < 1e-8
        intrinsics = result.group(camera, "intrinsics").value
        assert intrinsics == pytest.approx(np.array(simulation.truth.values[camera]["intrinsics"]), rel=1e-8)


@pytest.mark.parametrize(
    ("model", "intrinsics", "distortion", "turn_deg"),
    [
        ("eucm", (250.0, 249.0, 371.0, 245.0), (0.62, 1.09), 0.0),
        ("eucm", (110.0, 109.0, 371.0, 245.0), (0.6, 1.1), 70.0),  # corners up to 101 degrees off the axis
        ("double-sphere", (150.0, 151.0, 371.0, 245.0), (-0.2, 0.59), 0.0),
        ("double-sphere", (220.0, 221.0, 371.0, 245.0), (0.3, 0.7), 40.0),
        ("pinhole-rational", (330.0, 331.0, 371.0, 245.0), (3.1, 0.9, 2e-4, 1e-4, 0.02, 3.4, 1.9, 0.15), 0.0),
        ("omni-radtan", (300.0, 298.0, 371.0, 245.0), (1.2, -0.1, 0.03, 3e-4, -2e-4), 40.0),
    ],
)
def test_wide_lenses_are_recovered_from_nothing(model: str, intrinsics: tuple, distortion: tuple, turn_deg: float):
    """Seen from 0.35 m, by cameras turned away from the target."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    scenario = handheld(12.0, noiseless=True)
    cameras = tuple(
        dataclasses.replace(
            c, model=model, intrinsics=intrinsics, distortion=distortion, T_imu_sensor=c.T_imu_sensor @ turn
        )
        for c in scenario.cameras
    )
    motion = dataclasses.replace(scenario.motion, distance_m=0.35)
    simulation = simulate(dataclasses.replace(scenario, cameras=cameras, motion=motion), 1)
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free")
    result = calibrate_measurements(rig, simulation.measurements)
    assert result.converged, result.status
    for camera in ("cam0", "cam1"):
        assert max(extrinsics_error(result, simulation, camera)) < 1e-7
        assert result.group(camera, "intrinsics").value == pytest.approx(np.array(intrinsics), rel=1e-6)
        assert result.group(camera, "distortion").value == pytest.approx(np.array(distortion), rel=1e-6, abs=1e-9)


def test_a_double_sphere_finds_the_right_valley_in_noise():
    """With xi of the other sign it fits to 0.01 px, far below the noise of 0.2 px."""
    truth = np.array([250.0, 249.0, 371.0, 245.0, -0.18, 0.59])
    scenario = handheld(20.0)
    cameras = tuple(
        dataclasses.replace(c, model="double-sphere", intrinsics=tuple(truth[:4]), distortion=tuple(truth[4:]))
        for c in scenario.cameras
    )
    simulation = simulate(dataclasses.replace(scenario, cameras=cameras), 1)
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free")
    result = calibrate_measurements(rig, simulation.measurements)
    for camera in ("cam0", "cam1"):
        groups = [result.group(camera, name) for name in ("intrinsics", "distortion")]
        error = np.concatenate([g.value for g in groups]) - truth
        assert np.abs(error / np.concatenate([g.std_formal for g in groups])).max() < 4.0


@pytest.mark.parametrize(
    "target", [Charuco(8, 7, 0.08, 0.06, "5x5_100"), Checkerboard(6, 7, 0.08)], ids=lambda target: target.type
)
def test_boards_without_bloom_are_recovered(target: Target):
    simulation = simulate(dataclasses.replace(handheld(12.0, noiseless=True), target=target), 1)
    rig = rig_for(simulation.scenario)
    rig = dataclasses.replace(rig, settings=dataclasses.replace(rig.settings, bloom=True))
    result = calibrate_measurements(rig, simulation.measurements)
    assert result.converged, result.status
    for camera in ("cam0", "cam1"):
        assert max(extrinsics_error(result, simulation, camera)) < 1e-8
    assert not any(group.name == "bloom" for group in result.groups)


def real_corners() -> tuple[Scenario, Rig]:
    scenario = handheld(20.0)
    cameras = tuple(dataclasses.replace(c, bloom_px=b) for c, b in zip(scenario.cameras, (0.25, 0.30), strict=True))
    scenario = dataclasses.replace(scenario, cameras=cameras, bow=(1.0e-3, -0.5e-3, 0.7e-3), blur_s=3e-4)
    rig = rig_for(scenario)
    unknown = tuple(dataclasses.replace(c, corner_noise_px=None) for c in rig.cameras)
    settings = dataclasses.replace(rig.settings, bloom=True, board_shape=True, blur_noise=True)
    return scenario, rig.with_(cameras=unknown, settings=settings)


def test_bloom_bow_and_blur_are_recovered():
    scenario, rig = real_corners()
    simulation = simulate(scenario, 5)
    result = calibrate_measurements(rig, simulation.measurements)
    shape = result.group("board0", "shape")
    assert np.abs((shape.value[:3] - np.array(scenario.bow)) / shape.std_formal[:3]).max() < 4.0
    assert np.abs(shape.value[3:] / shape.std_formal[3:]).max() < 4.0
    for camera in scenario.cameras:
        bloom = result.group(camera.name, "bloom")
        assert abs(bloom.value[0] - camera.bloom_px) < 4.0 * bloom.std_formal[0]
        turn, move, offset = extrinsics_error(result, simulation, camera.name)
        assert turn < 1e-3
        assert move < 2e-3
        assert offset < 1e-4
    for residuals, camera in zip(result.corner_residuals, scenario.cameras, strict=True):
        assert residuals.sigma.min() == pytest.approx(camera.corner_noise_px, rel=0.25)
        true = simulation.truth.corners[camera.name].sigma
        assert np.median(residuals.sigma) == pytest.approx(np.median(true), rel=0.15)


def test_imu_intrinsics_of_one_percent_are_recovered():
    rng = np.random.default_rng(2)
    intrinsics = np.concatenate([rng.normal(0.0, 0.01, 15), rng.normal(0.0, 1e-3, 9)])
    scenario = dataclasses.replace(handheld(30.0), imu_intrinsics=intrinsics)
    simulation = simulate(scenario, 1)
    rig = rig_for(scenario)
    rig = rig.with_(imu=dataclasses.replace(not_none(rig.imu), intrinsics=Parameter("prior", np.zeros(24), FREE.sigma)))
    result = calibrate_measurements(rig, simulation.measurements)
    found = result.group("imu0", "intrinsics")
    assert np.abs((found.value - intrinsics) / found.std_formal).max() < 4.0
    assert found.std_formal.max() < 0.01
