"""Robots with LiDARs and wheels: covariances are honest, and what a drive over a flat floor leaves open is said."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from icalib.data.measurements import Measurements
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.result.verdict import UNUSABLE
from icalib.rig import Rig
from icalib.sensors.camera.initialize.target_with_imu import initial_guess
from icalib.tools.montecarlo.one_run import error, true_value
from icalib.tools.simulation import Scenario, Simulation, rig_for, simulate, with_drawn_guess

MOUNTS = ("rotation", "translation", "time_offset")
DRIVEN = (*MOUNTS, "radii", "baseline")
STEADY = 1e-4  # m/sqrt(s): simulated wheels do not slip
MOST_SIGMA = 4.0


@dataclass(frozen=True)
class Case:
    """An example of the paper, its length, what stands on the robot, points of a scan's ring, what is judged."""

    example: str
    seconds: float
    parts: str
    azimuth_steps: int
    blocks: tuple[str, ...]


WHEELS = Case("ramp", 30.0, "cw", 0, DRIVEN)
LIDAR = Case("3d", 16.0, "l", 150, MOUNTS)
FOUND = Case("3d", 16.0, "l", 600, MOUNTS)
ALL = Case("ramp", 30.0, "clw", 200, DRIVEN)


def steady(rig: Rig) -> Rig:
    """The rig, its wheels as free of slip as simulated ones."""
    return rig.with_(wheels=tuple(replace(w, lateral_slip=STEADY, vertical_slip=STEADY) for w in rig.wheels))


def as_measured(measurements: Measurements) -> Measurements:
    return measurements


def check(consistency, robot, case: Case, seeds: range, probability: float, seen=as_measured) -> None:
    scenario = robot(case.example, case.seconds, case.parts, case.azimuth_steps)
    found = consistency(scenario, steady(rig_for(scenario)), seeds, probability, case.blocks, seen)
    print({block: (round(c.mean, 3), round(c.low, 3), round(c.high, 3)) for block, c in found.items()})
    assert {block: c for block, c in found.items() if not c.consistent} == {}


def test_a_few_recordings_of_camera_and_wheels(consistency, robot):
    check(consistency, robot, WHEELS, range(3), 0.9999)


def test_a_few_recordings_of_a_lidar(consistency, robot):
    check(consistency, robot, replace(LIDAR, seconds=10.0), range(2), 0.9999)


def test_a_lidar_beside_a_noisy_imu(consistency, robot):
    """Between keyframes the gyroscope loses as much as the LiDAR sees: taken for exact there, NEES is 3.8."""
    scenario = robot("3d", 12.0, "l", 600)
    scenario = replace(scenario, imu_noise=scenario.imu_noise.scaled(10.0))
    rig = rig_for(scenario, time_offset="fixed")
    found = consistency(scenario, rig, range(12), 0.999, ("rotation", "translation"), as_measured)
    assert {block: c for block, c in found.items() if not c.consistent} == {}


def test_a_recording_of_a_lidar_whose_planes_are_found(consistency, robot):
    check(
        consistency, robot, replace(FOUND, seconds=10.0, azimuth_steps=300), range(1), 0.9999, Measurements.unassociated
    )


def test_a_recording_of_all_sensors(consistency, robot):
    check(consistency, robot, replace(ALL, seconds=20.0, azimuth_steps=300), range(1), 0.9999)


@pytest.mark.full
@pytest.mark.parametrize("case", [WHEELS, LIDAR, ALL], ids=["wheels", "LiDAR", "all"])
def test_fifty_recordings(consistency, robot, case: Case):
    check(consistency, robot, case, range(50), 0.99)


@pytest.mark.full
def test_fifty_recordings_whose_planes_are_found(consistency, robot):
    check(consistency, robot, FOUND, range(50), 0.99, Measurements.unassociated)


def test_a_target_far_away_shows_the_lever_arm(robot):
    """What one image has wrong of its rotation moves its position by five metres as much."""
    off = []
    for seed in range(4):
        simulation = simulate(robot("ramp", 20.0, "c"), seed)
        found = initial_guess(rig_for(simulation.scenario), simulation.measurements).cameras["cam0"]
        off.append(found.position - simulation.truth.T_imu_sensor["cam0"][:3, 3])
    assert np.sqrt(np.mean(np.square(off))) < 0.1


# On a flat floor.


def check_known(result: Calibration, simulation: Simulation) -> None:
    """Nothing that is called known is far off."""
    assert result.converged, result.status
    for g in result.groups:
        true = true_value(simulation.truth, g.sensor, g.name)
        if g.columns is not None and true is not None:
            z = np.abs(error(g.name, g.value, true) / g.std_formal)[[v not in UNUSABLE for v in g.verdict]]
            assert z.max(initial=0.0) < MOST_SIGMA, f"{g.sensor}.{g.name} {g.value} {true} {g.std_formal} {g.verdict}"


def check_heights(result: Calibration, simulation: Simulation, rig: Rig) -> None:
    """Along the axis that the robot turns about nothing is known, and all stays where the rig's guess has it."""
    up = simulation.truth.R_world_imu[0, 2]
    for sensor in (*rig.cameras, *rig.lidars, *rig.wheels):
        g = result.group(sensor.name, "translation")
        assert sensor.translation.value is not None
        assert g.verdict[2] == "unobservable" and g.verdict[0] not in UNUSABLE, f"{sensor.name} {g.verdict}"
        moved = (g.value - sensor.translation.value) @ up
        assert abs(moved) < 5e-3, f"{sensor.name} {moved}"


def check_roll(result: Calibration, rig: Rig) -> None:
    for wheels in rig.wheels:
        g = result.group(wheels.name, "rotation")
        assert g.verdict[0] == "unobservable" and not {*UNUSABLE} & {*g.verdict[1:]}, g.verdict
        assert wheels.rotation.value is not None
        assert abs(error("rotation", g.value, wheels.rotation.value)[0]) < np.deg2rad(0.5)


def check_planar(scenario: Scenario, seed: int, seen=as_measured) -> None:
    simulation = simulate(scenario, seed)
    rig = with_drawn_guess(rig_for(scenario), scenario, seed, only=MOUNTS)
    result = calibrate_measurements(rig, seen(simulation.measurements))
    check_known(result, simulation)
    check_heights(result, simulation, rig)
    check_roll(result, rig)


@pytest.mark.parametrize(("parts", "seed", "seconds"), [("cw", 0, 20.0), ("clw", 1, 16.0), ("l", 2, 10.0)])
def test_a_flat_floor_leaves_heights_and_the_roll_of_wheels_at_the_guess(robot, parts: str, seed: int, seconds: float):
    check_planar(robot("planar", seconds, parts), seed)


def test_a_flat_floor_with_no_guess_at_all(robot):
    """Wheels a third of a metre below the IMU, where nobody guessed them to be: a pitch of 2 deg leaks 12 mm of it into
    x, which must know so."""
    scenario = robot("planar", 16.0, "lw", 600)
    simulation = simulate(scenario, 0)
    result = calibrate_measurements(rig_for(scenario), simulation.measurements.unassociated())
    check_known(result, simulation)
    wheels = result.group("wheel0", "translation")
    off = wheels.value - simulation.truth.T_imu_sensor["wheel0"][:3, 3]
    assert abs(off[2]) > 0.3 and wheels.verdict[2] == "unobservable"
    assert (np.abs(off) < 2.0 * wheels.std_formal).all()


@pytest.mark.full
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("parts", ["cw", "clw", "l"])
def test_flat_floors(robot, parts: str, seed: int):
    check_planar(robot("planar", 30.0, parts, 600), seed, Measurements.unassociated)


# On a straight line, where gravity's direction hides behind the accelerometer's bias.


def straight(robot, parts: str, seed: int, seconds: float) -> tuple[Calibration, Simulation]:
    scenario = robot("planar", seconds, parts, 300)
    scenario = replace(scenario, motion=replace(scenario.motion, kind="straight-line"))
    simulation = simulate(scenario, seed)
    rig = steady(with_drawn_guess(rig_for(scenario), scenario, seed))
    return calibrate_measurements(rig, simulation.measurements), simulation


@pytest.mark.parametrize(("parts", "seed"), [("lw", 0), ("lw", 2), ("l", 0)])
def test_the_solver_does_not_creep_along_a_straight_line(robot, parts: str, seed: int):
    """Gravity's direction, of which the data say next to nothing, lies in a valley that is curved: in steps of damping
    it crept for 50 of them, or rested where the points' chi^2 was twice what it should be."""
    result, simulation = straight(robot, parts, seed, 20.0)
    check_known(result, simulation)
    assert sum(i.stage == "final" for i in result.iterations) < 25
    points = next(fit for fit in result.fits if fit.kind == "points")
    assert 0.95 < points.chi2 / points.dof < 1.05


def test_a_board_on_a_straight_line_turns_no_further_than_the_bias_allows(robot):
    """To see what the rest owes to it, it was turned by 334 deg, from where there is no way back: the radii were said
    to be open by 3 m."""
    result, simulation = straight(robot, "cw", 4, 30.0)
    check_known(result, simulation)
    assert result.group("wheel0", "radii").verdict == ("determined", "determined")


# What the model does not know of.


def displaced(measurements: Measurements, seed: int) -> Measurements:
    """A tenth of the points is nearer or farther than what they should have hit."""
    rng, damaged = np.random.default_rng(seed), []
    for x in measurements.lidars:
        own, xyz = rng.random(len(x.xyz)) < 0.1, x.xyz.copy()
        xyz[own] *= rng.uniform(0.2, 1.1, (own.sum(), 1)).astype(np.float32)
        damaged.append(replace(x, xyz=xyz))
    return measurements.with_streams(*damaged).unassociated()


def passed_by(measurements: Measurements, seed: int) -> Measurements:
    """Somebody walks round the LiDAR two metres away, and hides a tenth of what it would see."""
    rng, damaged = np.random.default_rng(seed), []
    for x in measurements.lidars:
        seconds = np.repeat(x.seconds, np.diff(x.start)) + x.offset_s
        aside = (np.arctan2(x.xyz[:, 1], x.xyz[:, 0]) - 0.5 * seconds + np.pi) % (2.0 * np.pi) - np.pi
        far = np.linalg.norm(x.xyz, axis=1)
        hidden = (np.abs(aside) < 0.1 * np.pi) & (far > 2.3)
        near = 2.0 + 0.2 * np.cos(10.0 * aside) + 0.03 * rng.standard_normal(len(far))
        damaged.append(replace(x, xyz=np.where(hidden, near / far, 1.0).astype(np.float32)[:, None] * x.xyz))
    return measurements.with_streams(*damaged).unassociated()


def check_outliers(robot, seed: int, damage, case: Case) -> None:
    scenario = robot(case.example, case.seconds, case.parts, case.azimuth_steps)
    simulation, rig = simulate(scenario, seed), rig_for(scenario)
    rig = replace(rig, settings=replace(rig.settings, loss="huber"))
    result = calibrate_measurements(rig, damage(simulation.measurements, seed))
    check_known(result, simulation)
    T = simulation.truth.T_imu_sensor["lidar0"]
    assert np.linalg.norm(result.group("lidar0", "translation").value - T[:3, 3]) < 3e-3
    assert np.rad2deg(np.linalg.norm(error("rotation", result.group("lidar0", "rotation").value, T[:3, :3]))) < 0.03


def test_points_that_hit_something_else(robot):
    check_outliers(robot, 0, displaced, replace(FOUND, seconds=10.0, azimuth_steps=300))


@pytest.mark.full
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("damage", [displaced, passed_by])
def test_a_tenth_of_the_points_are_outliers(robot, damage, seed: int):
    check_outliers(robot, seed, damage, FOUND)


def check_slip(robot, degrees: float, seed: int) -> None:
    """At the slip density that rigs have if they say nothing."""
    scenario = robot("ramp", 30.0, "cw")
    scenario = replace(scenario, motion=replace(scenario.motion, sideslip_deg=degrees))
    simulation = simulate(scenario, seed)
    check_known(calibrate_measurements(rig_for(scenario), simulation.measurements), simulation)


def test_wheels_that_slide_sideways(robot):
    check_slip(robot, 1.25, 0)


@pytest.mark.full
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("degrees", [0.5, 1.25])  # at the drives' 0.9 m/s or so 4 and 10 mm/s RMS
def test_drives_with_sideslip(robot, degrees: float, seed: int):
    check_slip(robot, degrees, seed)
