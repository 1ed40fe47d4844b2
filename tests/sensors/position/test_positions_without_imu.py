"""Positions beside a camera that sees a target or a pose sensor, without an IMU: the motion is assumed to be smooth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from tests.sensors.position.test_position_runs import ARM
from tests.sensors.position.test_shared_frames import SILENT, with_mocap, with_target

from icalib.export.formats import write_outputs
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.result.verdict import UNUSABLE
from icalib.sensors.position.stream import PositionStream
from icalib.tools.simulation import Scenario, Simulation, rig_for, simulate

pytestmark = pytest.mark.slow

# The body; whether the frame of the positions is that of the target, or of the pose sensor, or their own.
CASES = [("cam0", True), ("cam0", False), ("mocap0", True), ("mocap0", False)]
MADE = {"cam0": with_target, "mocap0": with_mocap}


def calibrated(scenario: Scenario, shared: bool, seed: int = 1) -> tuple[Calibration, Simulation]:
    sim = simulate(scenario, seed)
    rig = rig_for(scenario).with_(imu=None)
    rig = rig if shared else rig.with_("gnss0", frame="tilted")
    return calibrate_measurements(rig, sim.measurements.without("imu0")), sim


def errors(result: Calibration, sim: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """(4,) of lever arm [m] and time offset [s] relative to the body, and their covariance."""
    T, offsets = sim.truth.T_imu_sensor[result.body], sim.truth.time_offset
    arm = T[:3, :3].T @ (ARM - T[:3, 3])
    offset = np.ravel(result.value("gnss0", "time_offset")) - offsets["gnss0"] + offsets[result.body]
    own = [k for k, name in enumerate(result.covariance_names) if name.startswith("gnss0.")]
    return np.append(result.value("gnss0", "translation") - arm, offset), result.covariance[np.ix_(own, own)]


@pytest.mark.parametrize(
    ("body", "shared"),
    [pytest.param(*case, marks=() if case == CASES[0] else pytest.mark.full) for case in CASES],
)
def test_from_nothing(body, shared, tmp_path):
    """Without noise the errors are those of the assumption: a twentieth of what noise would make."""
    result, sim = calibrated(MADE[body](**SILENT), shared)
    assert result.body == body and result.imu is None
    error, covariance = errors(result, sim)
    assert (np.abs(error) < 0.05 * np.sqrt(np.diag(covariance))).all()
    assert not {*UNUSABLE} & {*result.group("gnss0", "translation").verdict}
    write_outputs(result, tmp_path)
    assert "gnss0" in (tmp_path / "report.html").read_text()


def test_two_recordings():
    sims = [simulate(with_mocap(duration_s=10.0), seed) for seed in (1, 2)]
    (stream,) = sims[1].measurements.of(PositionStream)
    later = sims[1].measurements.without("imu0").with_streams(replace(stream, stamps_ns=stream.stamps_ns + 400_000_000))
    rig = rig_for(sims[0].scenario).with_(imu=None).with_("gnss0", clock_restarts=True)
    result = calibrate_measurements(rig, [sims[0].measurements.without("imu0"), later])
    truth = sims[0].truth.time_offset
    offsets = np.ravel(result.value("gnss0", "time_offset")) - truth["gnss0"] + truth["mocap0"]
    np.testing.assert_allclose(offsets, [0.0, -0.4], atol=6e-3)
    np.testing.assert_allclose(result.value("gnss0", "translation"), ARM - 0.1, atol=0.02)


def test_positions_more_precise_than_poses():
    """What the assumed motion neglects between keyframes does not show."""
    scenario = with_mocap()
    mocap, prism = scenario.sensors
    poor = replace(mocap, rotation_noise=0.01, position_noise=0.01)
    precise = replace(prism, position_noise=2e-4, rate_hz=20.0)
    result, sim = calibrated(replace(scenario, sensors=(poor, precise)), True)
    error, covariance = errors(result, sim)
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(covariance))).all()


@pytest.mark.full
@pytest.mark.parametrize(("body", "shared"), CASES)
def test_errors_are_as_large_as_their_covariance_says(body, shared):
    nees = []
    for seed in range(30):
        error, covariance = errors(*calibrated(MADE[body](), shared, seed))
        nees.append(error @ np.linalg.solve(covariance, error))
    low, high = chi2.ppf([0.005, 0.995], 4 * len(nees)) / len(nees)
    print(body, shared, np.mean(nees) / 4)
    assert low < np.mean(nees) < high
