"""Clocks that were set or restarted between recordings: a time offset in each, everything else shared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.stats import chi2
from tests.typed import instance

from icalib.data.measurements import WheelStream
from icalib.errors import EstimationError, RecordingError
from icalib.export.formats import write_outputs
from icalib.geometry.targets import NoTarget
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration, joint_covariance, load_calibration
from icalib.rig import Parameter, Rig
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.simulation import Scenario, Simulation, load_scenario, rig_for, simulate

PAPER = Path(__file__).parents[2] / "examples" / "paper"
T_IMU_MOCAP = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.05], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
KINDS = {"c": "cameras", "l": "lidars", "w": "wheels"}
SET_BACK_S = {"c": 37.123, "l": -512.3, "w": 1234.567}


def mocap() -> SimPoses:
    return SimPoses("mocap0", T_IMU_MOCAP, rotation_noise=1e-3, position_noise=5e-4, time_offset_s=0.004)


def reset(scenario: Scenario, parts: str) -> Scenario:
    """The same scenario, the clocks of some of its sensors set back or forward, each by another time."""

    def moved(sensor: Any, part: str) -> Any:
        back = round(1e9 * SET_BACK_S[part]) if part in parts else 0
        return replace(sensor, clock_origin_ns=sensor.clock_origin_ns - back)

    cameras = tuple(moved(c, "c") for c in scenario.cameras)
    sensors = tuple(moved(s, s.sensor_type[0]) for s in scenario.sensors)
    return replace(scenario, cameras=cameras, sensors=sensors)


def open_rig(scenario: Scenario, restarting: str) -> Rig:
    """Nothing is known of how sensors stand and of their clocks."""
    rig, free = rig_for(scenario), Parameter()
    for part, kind in KINDS.items():
        changes = {"rotation": free, "translation": free, "time_offset": free, "clock_restarts": part in restarting}
        if kind == "wheels":
            changes |= {"radii": free, "baseline": free, "lateral_slip": 1e-4, "vertical_slip": 1e-4}
        rig = rig.with_(**{kind: tuple(replace(s, **changes) for s in getattr(rig, kind))})
    return rig


def pair(robot, example: str, parts: str, azimuth_steps: int) -> tuple[Simulation, Simulation]:
    scenario = robot(example, 18.0, parts, azimuth_steps)
    return simulate(scenario, 1), simulate(reset(replace(scenario, duration_s=16.0), parts), 2)


def joint(simulations: tuple[Simulation, ...], rig: Rig) -> Calibration:
    return calibrate_measurements(rig, [s.measurements for s in simulations])


def check_offsets(result: Calibration, simulations: tuple[Simulation, ...]) -> None:
    """All of them together, inside their chi^2 bounds."""
    groups = [g for g in result.groups if g.name == "time_offset"]
    errors = np.concatenate([g.value - [s.truth.time_offset[g.sensor] for s in simulations] for g in groups])
    P = joint_covariance(result, groups)
    low, high = chi2.ppf([0.0005, 0.9995], len(errors))
    assert low < errors @ np.linalg.solve(P, errors) < high, errors / np.sqrt(np.diag(P))
    assert np.abs(errors).max() < 5e-3


@pytest.mark.parametrize(
    ("example", "parts", "azimuth_steps"),
    [("ramp", "cw", 0), *(pytest.param(*x, marks=pytest.mark.full) for x in (("3d", "l", 300), ("ramp", "clw", 300)))],
)
def test_each_recording_has_its_own(robot, example, parts, azimuth_steps):
    simulations = pair(robot, example, parts, azimuth_steps)
    result = joint(simulations, open_rig(simulations[0].scenario, parts))
    assert result.converged, result.status
    group = next(g for g in result.groups if g.name == "time_offset")
    assert group.labels == ("in recording 1", "in recording 2")
    check_offsets(result, simulations)


@pytest.mark.full
def test_a_clock_that_ran_on_is_no_worse(robot):
    """Two offsets of one clock agree, and all else is what one offset gives, if not quite as well known."""
    scenario = robot("3d", 14.0, "c")
    simulations = simulate(scenario, 1), simulate(replace(scenario, duration_s=12.0), 2)
    one, two = (joint(simulations, open_rig(scenario, parts)) for parts in ("", "c"))
    for name in ("rotation", "translation"):
        a, b = one.group("cam0", name), two.group("cam0", name)
        assert (b.std_formal > 0.9 * a.std_formal).all()
    offsets = two.group("cam0", "time_offset")
    P = joint_covariance(two, [offsets])
    apart = np.array([1.0, -1.0])
    assert abs(apart @ offsets.value) < 4.0 * np.sqrt(apart @ P @ apart)
    assert one.group("cam0", "time_offset").labels == ("time_offset",)


@pytest.mark.full
def test_one_recording_has_one(robot):
    scenario = robot("3d", 14.0, "c")
    result = joint((simulate(scenario, 1),), open_rig(scenario, "c"))
    assert result.group("cam0", "time_offset").labels == ("time_offset",)


@pytest.mark.full
def test_a_prior_is_one_of_each(robot):
    """It moves both offsets as it moves one."""
    scenario = robot("3d", 14.0, "c")
    simulations = simulate(scenario, 1), simulate(replace(scenario, duration_s=12.0), 2)
    rig = open_rig(scenario, "c")
    prior = Parameter("prior", np.array([0.01]), np.array([1e-7]))
    held = rig.with_(cameras=tuple(replace(c, time_offset=prior) for c in rig.cameras))
    group = joint(simulations, held).group("cam0", "time_offset")
    assert np.abs(group.value - 0.01).max() < 1e-6
    assert (np.abs(group.std_formal / 1e-7 - 1.0) < 0.01).all()


def test_without_saying_so_it_is_named(robot):
    simulations = pair(robot, "3d", "c", 0)
    with pytest.raises(EstimationError, match="write clock_restarts: true for the sensor in the rig file"):
        joint(simulations, open_rig(simulations[0].scenario, ""))


@pytest.mark.full
def test_a_stream_that_outlasts_the_others(robot):
    """Recordings follow one another on one clock, whichever of their sensors is looked at first."""
    scenario = robot("ramp", 18.0, "cw")
    first, second = simulate(scenario, 1), simulate(replace(scenario, duration_s=16.0), 2)
    (wheels,) = first.measurements.wheels
    n, step = 4000, int(np.median(np.diff(wheels.stamps_ns)))
    stamps = np.concatenate([wheels.stamps_ns, wheels.stamps_ns[-1] + step * np.arange(1, n + 1)])
    longer = replace(
        wheels, stamps_ns=stamps, rate=np.concatenate([instance(wheels, WheelStream).rate, np.zeros((n, 2))])
    )
    first = replace(first, measurements=first.measurements.with_streams(longer))
    result = joint((first, second), open_rig(scenario, ""))
    assert result.converged
    check = result.group("wheel0", "time_offset")
    assert abs(check.value[0] - first.truth.time_offset["wheel0"]) < 4.0 * check.std[0]


def test_outputs(robot, tmp_path):
    """Files, summaries and the report name the recordings."""
    simulations = pair(robot, "3d", "c", 0)
    result = joint(simulations, open_rig(simulations[0].scenario, "c"))
    write_outputs(result, tmp_path)
    back = load_calibration(tmp_path)
    assert back.group("cam0", "time_offset").labels == ("in recording 1", "in recording 2")
    assert (back.group("cam0", "time_offset").value == result.group("cam0", "time_offset").value).all()
    (first, second) = yaml.safe_load((tmp_path / "calibration.yaml").read_text())["sensors"]["cam0"]["time_offset"]
    assert abs(first - 0.01) < 1e-3 and abs(second - 0.01 - SET_BACK_S["c"]) < 1e-2
    assert "in recording 2" in (tmp_path / "report.html").read_text()


def test_a_recording_with_nothing_of_a_sensor_is_named(robot):
    scenario = robot("ramp", 18.0, "cw")
    blind = simulate(replace(scenario, duration_s=12.0), 2).measurements
    assert len(blind.cameras[0].stamps_ns) == 0
    blind = replace(blind, name="second")
    with pytest.raises(RecordingError, match="second: cam0 has no data"):
        calibrate_measurements(open_rig(scenario, ""), [simulate(scenario, 1).measurements, blind])


@pytest.mark.full
def test_cameras_that_follow_points(robot):
    """Without a target: tracks of both recordings, the second camera's clock set back between them."""
    scenario = replace(load_scenario(PAPER / "table2-3d.yaml"), sensors=(), duration_s=8.0)
    first, second, third = scenario.cameras
    later = replace(second, clock_origin_ns=second.clock_origin_ns - round(1e9 * SET_BACK_S["c"]))
    simulations = simulate(scenario, 1), simulate(replace(scenario, cameras=(first, later, third)), 2)
    rig = rig_for(scenario, intrinsics="start", distortion="start")
    cameras = tuple(replace(c, track_noise_px=1.0, clock_restarts=c.name == second.name) for c in rig.cameras)
    result = joint(simulations, rig.with_(target=NoTarget(), cameras=cameras))
    assert result.converged, result.status
    group = result.group(second.name, "time_offset")
    errors = group.value - [s.truth.time_offset[second.name] for s in simulations]
    assert np.abs(errors / group.std).max() < 4.0 and np.abs(errors).max() < 1e-3
    assert len(result.group(first.name, "time_offset").value) == 1


@pytest.mark.parametrize("parts", ["", pytest.param("c", marks=pytest.mark.full)])
def test_a_pose_sensor(robot, parts):
    """Beside a camera, and as what shows the motion."""
    scenario = robot("3d", 14.0, parts).with_sensors(mocap())
    later = replace(mocap(), clock_origin_ns=mocap().clock_origin_ns + 77 * 10**9)
    simulations = simulate(scenario, 1), simulate(replace(scenario.with_sensors(later), duration_s=12.0), 2)
    rig, free = rig_for(scenario), Parameter()
    poses = (replace(rig.poses[0], rotation=free, translation=free, time_offset=free, clock_restarts=True),)
    result = joint(simulations, rig.with_(poses=poses))
    assert result.converged, result.status
    group = result.group("mocap0", "time_offset")
    errors = group.value - [s.truth.time_offset["mocap0"] for s in simulations]
    assert np.abs(errors / group.std).max() < 4.0 and np.abs(errors).max() < 1e-3
