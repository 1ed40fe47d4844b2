"""Wheels on a flat floor and positions, without an IMU: the lever arm, the time offset and the sizes of the wheels."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from tests.sensors.position.test_position_runs import ARM, antenna, pose

from icalib.errors import EstimationError, RigError
from icalib.export.formats import write_outputs
from icalib.pipeline import calibrate, calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Ground, Parameter, Rig
from icalib.sensors.position.show import sections
from icalib.sensors.position.stream import PositionStream
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.inspection import draft_rig, inspect_recording
from icalib.tools.simulation import Drive, Room, Scenario, Simulation, rig_for, simulate, write_tables
from icalib.tools.simulation.trajectory import DriveKind

pytestmark = pytest.mark.slow

FLOOR, MOUNT = Ground("level", tilt_noise=5e-3), pose([0.1, 0.05, -0.3])
# Relative to the wheels: radii, baseline, lever arm, time offset.
ON_WHEELS = ARM - MOUNT[:3, 3]


def driven(seed=1, duration_s=60.0, motion: DriveKind = "planar", wheels=(), **fields) -> Simulation:
    base = SimWheels("wheels0", MOUNT, 0.013)
    sensors = replace(base, **dict(wheels)), antenna()
    room = Room((30.0, 20.0, 6.0))
    made = Scenario((), duration_s=duration_s, motion=Drive(motion), board=False, room=room, sensors=sensors, **fields)
    return simulate(made, seed)


def rig_without_imu(sim: Simulation, **fields) -> Rig:
    """No size of the wheels is stated."""
    return rig_for(sim.scenario).with_(imu=None).with_("wheels0", ground=FLOOR, **fields)


def calibrated(sim: Simulation, **fields) -> Calibration:
    return calibrate_measurements(rig_without_imu(sim, **fields), sim.measurements.without("imu0"))


def errors(result: Calibration, sim: Simulation, *sizes: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors of `sizes`, of the horizontal lever arm [m] and the time offset [s], and their covariance."""
    assert result.body == "wheels0" and result.imu is None
    truth = sim.truth
    offset = truth.time_offset["gnss0"] - truth.time_offset["wheels0"]
    true = {("wheels0", name): truth.values["wheels0"][name] for name in sizes}
    true |= {("gnss0", "translation"): ON_WHEELS, ("gnss0", "time_offset"): np.array([offset])}
    error = np.concatenate([np.ravel(result.value(*key)) - value for key, value in true.items()])
    assert result.group("gnss0", "translation").verdict[2] == "unobservable"
    known = np.delete(np.arange(len(error)), len(error) - 2)  # without the height of the lever arm
    return error[known], result.covariance[np.ix_(known, known)]


def test_without_noise():
    """Errors are those of the assumed motion: a twentieth of what noise would make."""
    sim = driven(robot_noise_enabled=False)
    result = calibrated(sim)
    error, covariance = errors(result, sim, "radii", "baseline")
    assert (np.abs(error) < 0.05 * np.sqrt(np.diag(covariance))).all()
    assert any("gnss0 translation z" in words for words in result.unobservable)


@pytest.mark.full
def test_errors_are_as_large_as_their_covariance_says():
    """Nothing is stated: no size of the wheels, no lever arm, no time offset."""
    nees = []
    for seed in range(8):
        sim = driven(seed)
        error, covariance = errors(calibrated(sim), sim, "radii", "baseline")
        assert (np.abs(error) < 3.0 * np.sqrt(np.diag(covariance))).all(), seed
        nees.append(error @ np.linalg.solve(covariance, error))
    low, high = chi2.ppf([0.005, 0.995], 6 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


def test_wrong_sizes():
    """Dead reckoning with these sizes would be off by 90 deg in each turn."""
    sim = driven(2)
    sizes = {"radii": Parameter("free", np.array([0.12, 0.12])), "baseline": Parameter("free", np.array([0.38]))}
    error, covariance = errors(calibrated(sim, **sizes), sim, "radii", "baseline")
    assert (np.abs(error) < 3.5 * np.sqrt(np.diag(covariance))).all()


@pytest.mark.parametrize(
    ("reports", "sizes"),
    [
        pytest.param("twist", ("scales",), marks=pytest.mark.full),
        ("steering", ("radius", "wheelbase", "steering_offset")),
    ],
)
def test_other_wheels(reports, sizes):
    """With an offset of the steering, dead reckoning without it turns too far; the drive repeats every 12 s."""
    sim = driven(3, 40.0, wheels={"reports": reports, "scales": (1.05, 0.93), "steering_offset": 0.02})
    error, covariance = errors(calibrated(sim), sim, *sizes)
    assert (np.abs(error) < 3.5 * np.sqrt(np.diag(covariance))).all()


def test_two_recordings():
    sims = [driven(seed, 25.0) for seed in (1, 2)]
    (stream,) = sims[1].measurements.of(PositionStream)
    later = sims[1].measurements.without("imu0").with_streams(replace(stream, stamps_ns=stream.stamps_ns + 400_000_000))
    rig = rig_without_imu(sims[0]).with_("gnss0", clock_restarts=True)
    result = calibrate_measurements(rig, [sims[0].measurements.without("imu0"), later])
    offset = sims[0].truth.time_offset["gnss0"] - sims[0].truth.time_offset["wheels0"]
    np.testing.assert_allclose(np.ravel(result.value("gnss0", "time_offset")) - offset, [0.0, -0.4], atol=0.015)
    np.testing.assert_allclose(result.value("gnss0", "translation")[:2], ON_WHEELS[:2], atol=0.05)
    (maps,) = (section for section in sections(result) if section.name == "maps")
    assert [plot.title for plot in maps.plots] == [f"gnss0 in {span.name}" for span in result.recordings]
    true = sims[1].truth.reported["gnss0"].position
    drawn = np.array([maps.plots[1].figure["data"][0][name] for name in "xy"]).T
    near = np.linalg.norm(drawn[:, None] - true[:, :2], axis=2).min(axis=1)
    assert len(drawn) > 0.9 * len(true) and np.sqrt(np.mean(near**2)) < 0.03


def test_from_files_and_the_draft_of_their_rig(tmp_path):
    sim, folder = driven(4, 25.0), tmp_path / "recording"
    write_tables(sim, 4, folder)
    shutil.rmtree(folder / "imu0")
    inspection = inspect_recording(folder)
    assert [f.sentence.split(".")[0] for f in inspection.findings] == [
        "There is no IMU, so smooth motion on a flat floor is assumed"
    ]
    (tmp_path / "rig.yaml").write_text(draft_rig(inspection))
    result = calibrate(tmp_path / "rig.yaml", folder)
    error, covariance = errors(result, sim, "radii", "baseline")
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(covariance))).all()
    write_outputs(result, tmp_path)
    assert "gnss0" in (tmp_path / "report.html").read_text()


def test_wheels_that_may_tilt_are_refused_with_what_to_write(tmp_path):
    sim = driven(4, 25.0)
    rig = rig_without_imu(sim).with_("wheels0", ground=None)
    with pytest.raises(RigError, match="write `ground: {plane: level, tilt_noise: 0.01}` in wheels0"):
        calibrate_measurements(rig, sim.measurements.without("imu0"))


def test_fixes_of_another_drive():
    sim, other = driven(1, 40.0), driven(5, 40.0, "straight-line")
    (fixes,) = other.measurements.of(PositionStream)
    with pytest.raises(EstimationError, match="wheels0: its speeds and turns do not match those of the positions"):
        calibrate_measurements(rig_without_imu(sim), sim.measurements.without("imu0").with_streams(fixes))


def test_an_imu_does_not_make_it_fail(monkeypatch):
    """Without a guess by the fixes and the IMU, the first guess is the motion by wheels and fixes."""

    def refused(*_):
        raise EstimationError("its fixes are too noisy")

    monkeypatch.setattr("icalib.sensors.position.initialize.motion_from_fixes", refused)
    sim = driven(1, 40.0)
    result = calibrate_measurements(rig_for(sim.scenario), sim.measurements)
    np.testing.assert_allclose(result.value("gnss0", "translation")[:2], ARM[:2], atol=0.03)
    np.testing.assert_allclose(result.value("wheels0", "radii"), sim.truth.values["wheels0"]["radii"], rtol=0.005)
