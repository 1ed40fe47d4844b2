"""Cameras alone: intrinsics, and extrinsics from images of the target taken together, against the truth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.export.formats import write_outputs
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration, load_calibration
from icalib.rig import Rig
from icalib.sensors.parameter import fixed
from icalib.tools.simulation import Scenario, Simulation, handheld, rig_for, simulate

EXACT = 1e-8


def stereo(noiseless: bool = False, apart_s: float = 0.0) -> Scenario:
    """Two cameras whose images are taken, and stamped, at the same instants, or `apart_s` one after the other."""
    scenario = handheld(8.0, noiseless=noiseless)
    cameras = tuple(
        dataclasses.replace(c, time_offset_s=0.0, rate_hz=4.0, phase_s=i * apart_s)
        for i, c in enumerate(scenario.cameras)
    )
    return dataclasses.replace(scenario, cameras=cameras)


def alone(simulation: Simulation) -> tuple[Rig, Measurements]:
    """Rig and measurements without the IMU, nothing known of the cameras."""
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free")
    return rig.with_(imu=None), simulation.measurements.without("imu0")


def errors(result: Calibration, simulation: Simulation) -> dict[tuple[str, str], np.ndarray]:
    """Estimated minus true by group; the truth of cam1's pose is that in cam0."""
    truth = simulation.truth
    T = np.linalg.inv(truth.T_imu_sensor["cam0"]) @ truth.T_imu_sensor["cam1"]
    found = {}
    for name in ("cam0", "cam1"):
        found[name, "intrinsics"] = result.group(name, "intrinsics").value - truth.values[name]["intrinsics"]
        found[name, "distortion"] = result.group(name, "distortion").value - truth.values[name]["distortion"]
    got = result.T_imu_sensor("cam1")
    found["cam1", "rotation"] = Rotation.from_matrix(T[:3, :3].T @ got[:3, :3]).as_rotvec()
    found["cam1", "translation"] = got[:3, 3] - T[:3, 3]
    return found


def test_noiseless_images_give_the_truth():
    simulation = simulate(stereo(noiseless=True), 1)
    result = calibrate_measurements(*alone(simulation))
    assert result.converged, result.status
    for (_, name), error in errors(result, simulation).items():
        assert np.abs(error).max() < EXACT * (460.0 if name == "intrinsics" else 1.0)


@pytest.mark.full
def test_the_covariance_is_honest():
    """NEES of everything that is estimated, over twelve recordings."""
    total, dof = 0.0, 0
    for seed in range(12):
        simulation = simulate(stereo(), seed)
        result = calibrate_measurements(*alone(simulation))
        found = errors(result, simulation)
        columns = np.concatenate([np.array(result.group(*key).columns) for key in found])
        error = np.concatenate(list(found.values()))
        total += float(error @ np.linalg.solve(result.covariance[np.ix_(columns, columns)], error))
        dof += len(error)
    low, high = chi2.ppf([0.0005, 0.9995], dof)
    assert low < total < high


def test_one_camera_gives_its_intrinsics():
    simulation = simulate(stereo(), 3)
    rig, measurements = alone(simulation)
    rig = rig.with_(cameras=rig.cameras[:1])
    result = calibrate_measurements(rig, measurements.only("cam0"))
    found = result.group("cam0", "intrinsics")
    assert np.abs((found.value - simulation.truth.values["cam0"]["intrinsics"]) / found.std).max() < 4.0
    np.testing.assert_array_equal(result.T_imu_sensor("cam0"), np.eye(4))


def test_cameras_that_never_look_together_are_named():
    rig, measurements = alone(simulate(stereo(apart_s=0.1), 1))
    with pytest.raises(EstimationError, match="cam1 and cam0 never saw the target at the same instant"):
        calibrate_measurements(rig, measurements)


def test_given_extrinsics_need_no_images_taken_together():
    simulation = simulate(stereo(apart_s=0.1), 1)
    rig, measurements = alone(simulation)
    truth = simulation.truth
    T = np.linalg.inv(truth.T_imu_sensor["cam0"]) @ truth.T_imu_sensor["cam1"]
    second = dataclasses.replace(rig.cameras[1], rotation=fixed(T[:3, :3]), translation=fixed(T[:3, 3]))
    result = calibrate_measurements(rig.with_(cameras=(rig.cameras[0], second)), measurements)
    assert result.converged, result.status
    np.testing.assert_allclose(result.T_imu_sensor("cam1"), T, atol=1e-12)


def test_outputs(tmp_path):
    result = calibrate_measurements(*alone(simulate(stereo(), 2)))
    write_outputs(result, tmp_path)
    names = {p.name for p in tmp_path.iterdir()}
    assert names == {"calibration.yaml", "camchain.yaml", "report.html", "result.json", "result.npz"}
    text = (tmp_path / "calibration.yaml").read_text()
    assert "T_cam0_sensor" in text and "T_imu_sensor" not in text
    assert "timeshift_cam_imu" not in (tmp_path / "camchain.yaml").read_text()
    again = load_calibration(tmp_path)
    assert again.imu is None and again.body == "cam0"
    np.testing.assert_array_equal(again.covariance, result.covariance)
