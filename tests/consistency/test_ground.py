"""Wheels that stand on a plane: what a drive over a flat floor then shows, and what hills say of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.typed import not_none

from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Ground, Parameter, Rig
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.montecarlo.record import error, true_value
from icalib.tools.simulation import Scenario, Simulation, rig_for, simulate, with_drawn_guess

MOUNTS = ("rotation", "translation", "time_offset")
TILT, HEIGHT = 5e-3, 2e-3  # of each keyframe [rad]; of what was measured [m]
FLOOR, LEVEL = Ground("floor", TILT, 0.0, HEIGHT, 2e-3), Ground("level", TILT, 0.0, HEIGHT, 2e-3)
TAPE_M = 3e-3


def standing(scenario: Scenario, seed: int, ground: Ground) -> Rig:
    """Guesses 5 deg and 5 cm off."""
    rig = with_drawn_guess(rig_for(scenario), scenario, seed, only=MOUNTS)
    return rig.with_(wheels=tuple(replace(w, ground=ground) for w in rig.wheels))


def check_known(result: Calibration, simulation: Simulation) -> None:
    """Nothing is farther off than its standard deviation says."""
    assert result.converged, result.status
    for g in result.groups:
        true = true_value(simulation.truth, g.sensor, g.name)
        if g.columns is not None and true is not None:
            z = np.abs(error(g.name, g.value, true) / g.std_formal)
            assert z.max(initial=0.0) < 4.0, f"{g.sensor}.{g.name} {g.value} {true} {g.std_formal} {g.verdict}"


def check_upright(result: Calibration, simulation: Simulation) -> None:
    """Roll and pitch to 0.03 deg, and so the baseline."""
    turn, baseline = result.group("wheel0", "rotation"), result.group("wheel0", "baseline")
    off = error("rotation", turn.value, simulation.truth.T_imu_sensor["wheel0"][:3, :3])
    assert turn.verdict[:2] == ("determined", "determined") and baseline.verdict == ("determined",)
    assert np.rad2deg(np.abs(off[:2])).max() < 0.03 and np.rad2deg(turn.std_formal[:2]).max() < 0.03
    assert abs(baseline.value[0] - simulation.truth.values["wheel0"]["baseline"][0]) < 1.5e-3


def test_a_flat_floor_that_the_lidar_sees(robot):
    """Where the LiDAR is over the IMU remains open, and with it the wheels; with a tape measure it is known as well."""
    scenario = robot("planar", 12.0, "lw")
    simulation, rig = simulate(scenario, 0), standing(scenario, 0, FLOOR)
    result = calibrate_measurements(rig, simulation.measurements)
    check_upright(result, simulation)
    check_known(result, simulation)
    assert any("lidar0 translation z with wheel0 translation z" in words for words in result.unobservable)
    assert result.group("wheel0", "ground_height").std_formal[0] == pytest.approx(HEIGHT, rel=0.05)

    (lidar,), mean = rig.lidars, simulation.truth.T_imu_sensor["lidar0"][:3, 3] + [0.1, 0.1, TAPE_M]
    tape = Parameter("prior", mean, np.array([1.0, 1.0, TAPE_M]))
    rig = rig.with_(lidars=(replace(lidar, translation=tape),))
    result = calibrate_measurements(rig, simulation.measurements)
    check_known(result, simulation)
    lower = result.group("wheel0", "translation")
    assert lower.std_formal[2] == pytest.approx(np.hypot(TAPE_M, HEIGHT), rel=0.1)
    assert abs((lower.value - simulation.truth.T_imu_sensor["wheel0"][:3, 3])[2] - TAPE_M) < 1e-3


def test_a_known_height_of_the_lidar_leaves_the_sigma_of_the_floors_height(robot):
    scenario = robot("planar", 12.0, "lw")
    simulation, rig = simulate(scenario, 0), standing(scenario, 0, FLOOR)
    (lidar,), there = rig.lidars, simulation.truth.T_imu_sensor["lidar0"][:3, 3]
    rig = rig.with_(lidars=(replace(lidar, translation=Parameter("fixed", there)),))
    result = calibrate_measurements(rig, simulation.measurements)
    check_known(result, simulation)
    lower = result.group("wheel0", "translation")
    assert result.unobservable == () and lower.verdict[2] == "determined"
    assert lower.std_formal[2] == pytest.approx(HEIGHT, rel=0.05)


def under_the_target(scenario: Scenario, simulation: Simulation) -> float:
    """Of the wheels' frame on the floor, over the origin of the world, which is that of the target."""
    wheel = (
        simulation.truth.position[0] + simulation.truth.R_world_imu[0] @ scenario.of(SimWheels)[0].T_imu_sensor[:3, 3]
    )
    return float(wheel[2] - simulation.truth.T_world_bodies[0, 2, 3])


def test_a_level_floor_under_a_target(robot):
    scenario = robot("planar", 20.0, "cw")
    simulation = simulate(scenario, 0)
    height = under_the_target(scenario, simulation)
    result = calibrate_measurements(standing(scenario, 0, replace(LEVEL, height=height)), simulation.measurements)
    check_upright(result, simulation)
    check_known(result, simulation)
    assert any("cam0 translation z with wheel0 translation z" in words for words in result.unobservable)


def test_hills_are_no_plane(robot):
    scenario = robot("ramp", 20.0, "cw")
    simulation = simulate(scenario, 0)
    height = under_the_target(scenario, simulation)
    result = calibrate_measurements(standing(scenario, 0, replace(LEVEL, height=height)), simulation.measurements)
    ratios = {f.kind: f.chi2_per_dof for f in result.fits if f.sensor == "wheel0"}
    assert not_none(ratios["ground tilt"]) > 10.0 and not_none(ratios["ground height"]) > 10.0
    assert any("wheel0 tilts against its ground" in words for words in result.warnings)
    assert any("wheel0 moves up and down over its ground" in words for words in result.warnings)
