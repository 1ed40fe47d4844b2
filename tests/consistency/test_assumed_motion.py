"""Wheels and pose sensors without an IMU: smooth motion is assumed in its place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2
from tests.consistency.test_robot import steady
from tests.typed import not_none

from icalib.data.measurements import Measurements, PoseStream
from icalib.errors import EstimationError
from icalib.export.outputs import write_outputs
from icalib.initialize.assumed_motion import _with_rate
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration, load_calibration
from icalib.result.verdict import UNUSABLE
from icalib.rig import Rig
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.montecarlo.one_run import error, true_value
from icalib.tools.simulation import Drive, Scenario, Simulation, load_scenario, rig_for, simulate

PAPER = Path(__file__).parents[2] / "examples" / "paper"
MOUNT = ("rotation", "translation", "time_offset")
T_IMU_MOCAP = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.05], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])


T_OTHER = np.array([[0.0, 0.0, 1.0, -0.2], [1.0, 0.0, 0.0, 0.3], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]])


def mocap(name: str = "mocap0", T: np.ndarray = T_IMU_MOCAP, **others) -> SimPoses:
    """With a frame that is tilted by a quarter turn: nothing says where up is."""
    tilted = np.array([[1.0, 0.0, 0.0, 2.0], [0.0, 0.0, -1.0, 1.0], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0]])
    usual = {"rotation_noise": 1e-3, "position_noise": 5e-4, "time_offset_s": 0.004, "clock_origin_ns": 5_000_000_000}
    return SimPoses(name, T, T_world_frame=tilted, **usual | others)


def without_imu(scenario: Scenario, seed: int = 0) -> tuple[Rig, Measurements, Simulation]:
    simulation = simulate(replace(scenario, imu_noise_enabled=False), seed)
    return rig_for(scenario).with_(imu=None), simulation.measurements.without("imu0"), simulation


def true_beside(simulation: Simulation, body: str, sensor: str, name: str) -> np.ndarray | None:
    """As `true_value`, of a sensor as seen from the body's."""
    values = {s: {n: true_value(simulation.truth, s, n) for n in MOUNT} for s in (body, sensor)}
    (R, p, t), (Q, q, u) = (tuple(values[s][n] for n in MOUNT) for s in (body, sensor))
    beside = {
        "rotation": not_none(R).T @ Q,
        "translation": not_none(R).T @ (not_none(q) - p),
        "time_offset": not_none(u) - t,
    }
    return beside.get(name, true_value(simulation.truth, sensor, name))


def normalised(result: Calibration, simulation: Simulation, only: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Errors of what is estimated, and their covariance, of all sensors or `only` one."""
    errors, columns = [], []
    for g in result.groups:
        if g.columns is None or only not in (None, g.sensor):
            continue
        true = true_beside(simulation, result.body, g.sensor, g.name)
        if true is not None:
            errors += list(error(g.name, g.value, true))
            columns += list(g.columns)
    return np.array(errors), result.covariance[np.ix_(columns, columns)]


def check_known(result: Calibration, simulation: Simulation, count: int) -> None:
    assert result.converged, result.status
    e, P = normalised(result, simulation)
    assert len(e) == count
    assert np.abs(e / np.sqrt(np.diag(P))).max() < 4.0, (e, np.sqrt(np.diag(P)))


def test_wheels_and_motion_capture_on_ramps(robot, tmp_path):
    scenario = robot("ramp", 20.0, "w").with_sensors(mocap())
    rig, measurements, simulation = without_imu(scenario)
    result = calibrate_measurements(rig, measurements)
    check_known(result, simulation, 10)
    assert result.imu is None and result.body == "mocap0"
    assert {g.sensor for g in result.groups} == {"mocap0", "wheel0"}
    assert {f.sensor for f in result.fits} == {"mocap0", "wheel0"}
    assert set(result.group("mocap0", "rotation").verdict) == {"fixed"}
    assert set(result.group("wheel0", "radii").verdict) == {"determined"}
    assert result.group("wheel0", "radii").std_formal.max() < 3e-5
    assert any("there is no IMU" in words for words in result.notes)
    assert not any("noise density" in words for words in result.warnings)
    write_outputs(result, tmp_path)
    assert "T_mocap0_sensor" in (tmp_path / "calibration.yaml").read_text()
    again = load_calibration(tmp_path)
    assert again.body == "mocap0"
    np.testing.assert_array_equal(again.T_imu_sensor("wheel0"), result.T_imu_sensor("wheel0"))


def test_a_camera_with_a_target_and_wheels(robot):
    rig, measurements, simulation = without_imu(robot("ramp", 20.0, "cw"))
    result = calibrate_measurements(rig, measurements)
    check_known(result, simulation, 10)
    assert result.body == "cam0" and set(result.group("cam0", "time_offset").verdict) == {"fixed"}
    assert result.group("wheel0", "radii").std_formal.max() < 1e-4


@pytest.mark.parametrize("seed", [3, 6])
def test_a_target_that_is_out_of_sight_for_long(robot, seed):
    """Nothing is made up of the 14 s between."""
    rig, measurements, simulation = without_imu(robot("ramp", 20.0, "cw"), seed)
    assert np.diff(measurements.cameras[0].seconds).max() > 13.0
    check_known(calibrate_measurements(rig, measurements), simulation, 10)


def test_two_pose_sensors(robot):
    """What is called hand-eye calibration."""
    poses = (mocap(), mocap("slam0", T_OTHER, time_offset_s=-0.02, rate_hz=30.0))
    scenario = robot("3d", 12.0, "").with_sensors(*poses)
    rig, measurements, simulation = without_imu(scenario)
    result = calibrate_measurements(rig, measurements)
    check_known(result, simulation, 7)
    assert result.unobservable == ()
    assert np.rad2deg(result.group("slam0", "rotation").std_formal).max() < 0.05


def test_on_a_flat_floor_height_and_roll_remain_open(robot):
    rig, measurements, simulation = without_imu(robot("planar", 20.0, "w").with_sensors(mocap()))
    result = calibrate_measurements(rig, measurements)
    assert result.converged, result.status
    assert result.group("wheel0", "rotation").verdict[0] == "unobservable"
    assert result.group("wheel0", "translation").verdict[2] == "unobservable"
    e, P = normalised(result, simulation)
    known = [k for k, v in enumerate(sum((g.verdict for g in result.groups if g.columns), ())) if v not in UNUSABLE]
    assert np.abs(e / np.sqrt(np.diag(P)))[known].max() < 4.0


def test_cameras_that_follow_points_and_motion_capture_from_nothing(robot):
    """Of the camera there is no guess, lens included; the body is the motion capture's."""
    scenario = load_scenario(PAPER / "table2-3d.yaml")
    camera = replace(scenario.cameras[0], corner_noise_px=0.3)
    scenario = replace(scenario, duration_s=12.0, cameras=(camera,), sensors=(mocap(),))
    simulation = simulate(replace(scenario, imu_noise_enabled=False), 0)
    rig = rig_for(scenario, intrinsics="free", distortion="free").with_(imu=None)
    result = calibrate_measurements(rig, simulation.measurements.without("imu0"))
    assert result.body == "mocap0"
    check_known(result, simulation, 7 + 8)


def test_one_arc_all_the_time_is_refused(robot):
    """What its wheels then show is one ratio, no radii and no baseline."""
    scenario = replace(robot("planar", 20.0, "w").with_sensors(mocap()), motion=Drive("arc"))
    rig, measurements, _ = without_imu(scenario)
    with pytest.raises(EstimationError, match="the yaw rate was nearly constant"):
        calibrate_measurements(rig, measurements)


def followed_by_wheels(example: str, seed: int, drive: str) -> tuple[Rig, Measurements, Simulation]:
    """A camera that follows points, wheels, and nothing else; of the camera nothing is known."""
    scenario = load_scenario(PAPER / f"table2-{example}.yaml")
    cameras = tuple(replace(c, corner_noise_px=0.5) for c in scenario.cameras[:1])
    scenario = replace(scenario, duration_s=15.0, cameras=cameras, sensors=scenario.of(SimWheels))
    simulation = simulate(scenario, seed)
    rig = rig_for(scenario, intrinsics="free", distortion="free", radii=drive, baseline=drive)  # pyright: ignore
    return rig.with_(imu=None), simulation.measurements.without("imu0"), simulation


@pytest.mark.parametrize(("seed", "drive"), [(1, "start"), (2, "fixed")])
def test_cameras_that_follow_points_and_wheels_on_a_floor(seed, drive):
    """The size of the scene is as the rig file has the wheels'."""
    rig, measurements, simulation = followed_by_wheels("planar", seed, drive)
    result = calibrate_measurements(rig, measurements)
    assert result.body == "cam0" and result.converged
    e, P = normalised(result, simulation)
    assert np.abs(e / np.sqrt(np.diag(P))).max() < 4.0
    assert set(result.group("cam0", "intrinsics").verdict) == {"determined"}
    assert set(result.group("wheel0", "radii").verdict) == {"unobservable" if drive == "start" else "fixed"}


@pytest.mark.parametrize(
    ("example", "drive", "words"),
    [
        ("ramp", "start", "determines the motion on a flat floor only"),
        ("planar", "free", "give its radii and baseline"),
    ],
)
def test_what_wheels_do_not_show_to_cameras_that_follow_points(example, drive, words):
    rig, measurements, _ = followed_by_wheels(example, 1, drive)
    with pytest.raises(EstimationError, match=words):
        calibrate_measurements(rig, measurements)


@pytest.mark.full
def test_nees(robot):
    """Of what does not hang on the slip that the rig file allows for, and simulated wheels do not have: yaw, pitch and
    sideways are known far better than their standard deviations say."""
    scenario = robot("ramp", 20.0, "w").with_sensors(mocap())
    seen = np.array([0, 3, 5, 6, 7, 8, 9])  # roll, x, z, time offset, radii, baseline
    runs = []
    for seed in range(20):
        rig, measurements, simulation = without_imu(scenario, seed)
        e, P = normalised(calibrate_measurements(rig, measurements), simulation)
        runs.append(e[seen] @ np.linalg.solve(P[np.ix_(seen, seen)], e[seen]))
    low, high = chi2.ppf([0.005, 0.995], 20 * len(seen))
    assert low < np.sum(runs) < high, np.array(runs) / len(seen)


@pytest.mark.full
def test_nees_of_a_camera_and_wheels(robot):
    """Wheels as free of slip as simulated ones."""
    scenario, seen, runs = robot("ramp", 30.0, "cw"), np.array([0, 3, 5, 6, 7, 8, 9]), []
    for seed in range(30):
        rig, measurements, simulation = without_imu(scenario, seed)
        result = calibrate_measurements(steady(rig), measurements)
        assert result.converged, seed
        e, P = normalised(result, simulation)
        runs.append(e[seen] @ np.linalg.solve(P[np.ix_(seen, seen)], e[seen]))
    low, high = chi2.ppf([0.005, 0.995], len(runs) * len(seen))
    assert low < np.sum(runs) < high, np.array(runs) / len(seen)


def test_the_clock_of_wheels_that_say_more_than_the_poses(robot):
    """The rate of a keyframe is the mean until the next. Carried backwards as well, it goes with the noise of one
    neighbour more than with the other's, and the time offset is off by 0.6 ms, three standard deviations."""
    scenario = robot("ramp", 20.0, "w").with_sensors(mocap())
    normal = []
    for seed in (15, 16, 17, 19):
        rig, measurements, simulation = without_imu(scenario, seed)
        e, P = normalised(calibrate_measurements(rig, measurements), simulation)
        normal.append(e[6] / np.sqrt(P[6, 6]))
    assert abs(np.mean(normal)) < 1.3, normal  # 99 % of the mean of four


@pytest.mark.parametrize("first", ["mocap0", "cam0"])
def test_poses_of_half_a_degree_and_a_centimetre(robot, first):
    """As a target that is seen from far, and motion capture, whichever is the body."""
    poor = mocap("cam0", T_OTHER, rotation_noise=0.01, position_noise=0.01, time_offset_s=-0.02, rate_hz=30.0)
    poses = (mocap(), poor) if first == "mocap0" else (poor, mocap())
    rig, measurements, simulation = without_imu(robot("3d", 20.0, "").with_sensors(*poses))
    check_known(calibrate_measurements(rig, measurements), simulation, 7)


@pytest.mark.parametrize(("parts", "seconds"), [("w", 20.0), ("cw", 20.0), ("w", 300.0)])
def test_a_scale_that_no_measurement_shows_is_its_prior(robot, parts, seconds):
    """With an assumed motion or slip in metres, the last one ends at 0.9949, five standard deviations, and is not
    usable."""
    scenario = robot("ramp", seconds, parts)
    rig, measurements, simulation = without_imu(scenario.with_sensors(mocap()) if parts == "w" else scenario, 1)
    rig = rig.with_(
        target=replace(rig.target, size_sigma=2e-3), poses=tuple(replace(p, scale_sigma=1e-3) for p in rig.poses)
    )
    result = calibrate_measurements(steady(rig), measurements)
    assert result.converged and result.verdict != "not usable", result.reasons
    (scale,) = (g for g in result.groups if g.name in ("scale", "size"))
    assert scale.value[0] == pytest.approx(1.0, abs=0.05 * scale.std_formal[0])
    sizes = [result.group("wheel0", name) for name in ("radii", "baseline")]
    columns = np.concatenate([not_none(g.columns) for g in sizes])
    errors = np.concatenate([g.value - simulation.truth.values["wheel0"][g.name] for g in sizes])
    assert errors @ np.linalg.solve(result.covariance[np.ix_(columns, columns)], errors) < chi2.ppf(0.999, 3)


@pytest.mark.parametrize(("hz", "slow"), [(5.0, True), (20.0, False)])
def test_the_rate_of_the_sensor_that_shows_the_motion_is_named(hz: float, slow: bool):
    """Where another sensor does not match it. `assumed motion` is no sensor that a user knows."""
    poses = PoseStream("mocap0", np.arange(20) * round(1e9 / hz), np.tile(np.eye(3), (20, 1, 1)), np.zeros((20, 3)))
    words = _with_rate("the motion of cam0 does not match that of assumed motion at any time offset.", poses)
    assert words.startswith(f"the motion of cam0 does not match that of mocap0 at {hz:g} Hz at any time offset.")
    assert ("Record at 20 Hz" in words) == slow
