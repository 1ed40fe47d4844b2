"""The sheet of a target in the clouds of a LiDAR in motion: the points on it, what they say, and NEES."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import pytest
from scipy.stats import chi2
from tests.remarks import named, names
from tests.typed import not_none

from icalib.detection.planes import PlaneSearch
from icalib.geometry import so3
from icalib.geometry.targets import AprilGrid
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.sensors.lidar.board_factor import ON_SHEET, RIM_M, THROUGH_SHEET, TargetSheet
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.simulation import Scenario, Simulation, handheld, rig_for, simulate, with_drawn_guess
from icalib.tools.simulation.room import Room

# x of the LiDAR is z of the IMU, which faces the board; its z axis is nearly up.
FORWARDS = np.array([[0.0, 0.0, 1.0, 0.08], [0.0, -1.0, 0.0, 0.02], [1.0, 0.0, 0.0, -0.05], [0.0, 0.0, 0.0, 1.0]])
SHEET = (0.8, 0.8)
ROOM = Room()
OPEN = {"room": Room(size=(200.0, 200.0, 80.0)), "range_m": (0.3, 30.0)}  # the floor alone is in reach
MOUNTS = ("rotation", "translation", "time_offset")


def scene(seconds: float, room: Room = ROOM, sheet: tuple[float, float] | None = SHEET, **lidar) -> Scenario:
    """A camera, an IMU and a LiDAR of 16 rings in the hand, before a board in a room."""
    scenario = handheld(seconds)
    origin_ns = scenario.imu_clock_origin_ns
    usual = {"time_offset_s": 0.02, "rate_hz": 10.0, "azimuth_steps": 200, "clock_origin_ns": origin_ns}
    return replace(
        scenario,
        cameras=scenario.cameras[:1],
        target=AprilGrid(6, 6, 0.088, 0.3, sheet=sheet),
        sensors=(SimLidar("lidar0", FORWARDS, **usual | lidar),),
        room=room,
        motion=replace(scenario.motion, distance_m=1.5),
    )


@pytest.fixture(scope="module")
def scans() -> tuple[Simulation, np.ndarray, np.ndarray]:
    """A recording, its points in the world by the truth, and the positions that they are seen from."""
    simulation = simulate(scene(1.0), 0)
    return simulation, *in_world(simulation)


def in_world(simulation: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """All points in the world by the truth, and the positions that they are seen from."""
    stream, truth = simulation.measurements.lidars[0], simulation.truth
    since = (stream.stamps_ns - truth.imu_clock_origin_ns) * 1e-9 + truth.time_offset["lidar0"]
    R, p, _ = truth.pose_at(np.repeat(since, np.diff(stream.start)) + stream.offset_s)
    T = truth.T_imu_sensor["lidar0"]
    origins = p + R @ T[:3, 3]
    return origins + np.einsum("nij,nj->ni", R @ T[:3, :3], stream.xyz), origins


def true_sheet(simulation: Simulation) -> tuple[TargetSheet, np.ndarray]:
    """The sheet, and the place of its origin in the room."""
    scenario = simulation.scenario
    T = scenario.T_world_board
    return TargetSheet(T[:3, :3], scenario.target.outlines[0]), T[:3, 3]


def test_beams_that_hit_the_sheet_are_found_and_no_others(scans):
    simulation, points, origins = scans
    sheet, at = true_sheet(simulation)
    kinds = sheet.of_points(points - at, origins - at, PlaneSearch(noise_m=0.03, position_m=0.0, angle_rad=0.0))
    hit = simulation.measurements.lidars[0].plane < 0  # those of no face of the room
    assert hit.sum() > 1000
    assert hit[kinds == ON_SHEET].all() and (kinds[hit] > 0).mean() > 0.99
    assert (kinds[hit] == ON_SHEET).mean() > (1.0 - 4.0 * RIM_M / SHEET[0]) ** 2 - 0.05
    assert (kinds == THROUGH_SHEET).sum() < 0.01 * hit.sum()  # three standard deviations of noise behind it


def test_beams_go_through_a_sheet_that_is_elsewhere(scans):
    simulation, points, origins = scans
    sheet, at = true_sheet(simulation)
    beside = at - SHEET[0] * sheet.rotation[:, 0]
    kinds = sheet.of_points(points - beside, origins - beside, PlaneSearch())
    assert (kinds == THROUGH_SHEET).sum() > 2 * (kinds == ON_SHEET).sum()


def calibrated(simulation: Simulation, seed: int, longer_m: float = 0.0, sheet=SHEET) -> Calibration:
    """From guesses 5 deg, 5 cm and 20 ms off. longer_m: by how much ranges are too long; sheet: of the rig file."""
    (stream,) = simulation.measurements.lidars
    xyz = stream.xyz * (1.0 + longer_m / np.linalg.norm(stream.xyz, axis=1, keepdims=True))
    rig = with_drawn_guess(rig_for(simulation.scenario), simulation.scenario, seed, only=MOUNTS)
    target = AprilGrid(6, 6, 0.088, 0.3, sheet=sheet, size_sigma=rig.target.size_sigma)
    rig = replace(rig, target=target)
    unknown = replace(stream, xyz=xyz.astype(np.float32), plane=np.full_like(stream.plane, -1))
    result = calibrate_measurements(rig, simulation.measurements.with_streams(unknown))
    assert result.converged, result.status
    return result


def off(result: Calibration, simulation: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """(7,) errors of rotation [rad], translation [m] and time offset [s] of the LiDAR, and their covariance."""
    truth = simulation.truth
    T = truth.T_imu_sensor["lidar0"]
    groups = [result.group("lidar0", name) for name in MOUNTS]
    turn = so3.log(np.ascontiguousarray(T[:3, :3].T @ groups[0].value))
    errors = [turn, groups[1].value - T[:3, 3], groups[2].value - truth.time_offset["lidar0"]]
    columns = np.concatenate([not_none(g.columns) for g in groups])
    return np.concatenate(errors), result.covariance[np.ix_(columns, columns)]


def check_near(errors: np.ndarray) -> None:
    assert np.linalg.norm(errors[:3]) < np.deg2rad(0.04)
    assert np.linalg.norm(errors[3:6]) < 3e-3 and abs(errors[6]) < 3e-4


def test_the_sheet_shows_that_ranges_are_too_long():
    """Without it nothing does, and the LiDAR is 2 mm off, seven standard deviations."""
    simulation = simulate(scene(8.0, azimuth_steps=300), 1)
    result = calibrated(simulation, 1, longer_m=0.03)
    offset = result.group("lidar0", "range_offset")
    assert abs(offset.value[0] - 0.03) < 4.0 * offset.std[0] < 2e-3
    assert "too far" in named("ranges_offset", result.notes)
    assert "lidar_points_on_sheet" in names(result.notes)
    errors, covariance = off(result, simulation)
    check_near(errors)
    assert errors @ np.linalg.solve(covariance, errors) < chi2.ppf(0.999, 7)


def test_without_the_board_in_its_clouds_a_lidar_gets_the_results_of_before():
    simulation = simulate(scene(4.0, sheet=None), 0)
    stated, before = (calibrated(simulation, 0, sheet=sheet) for sheet in (SHEET, None))
    assert "target_unseen_by_lidar" in names(stated.notes) and "target_unseen_by_lidar" not in names(before.notes)
    for g in before.groups:
        np.testing.assert_array_equal(stated.group(g.sensor, g.name).value, g.value)


class OffCentreGrid(AprilGrid):
    """A grid that is printed 1 cm to the left of the middle of its sheet, and 2 cm above it."""

    @cached_property
    def outlines(self) -> np.ndarray:
        return super().outlines + [0.01, -0.02]


def test_a_print_beside_the_middle_of_its_sheet_is_found_and_does_no_harm():
    grid = OffCentreGrid(6, 6, 0.088, 0.3, sheet=SHEET)
    simulation = simulate(replace(scene(8.0, azimuth_steps=300), target=grid), 1)
    result = calibrated(simulation, 1)
    middle = result.group("board0", "sheet_middle")
    assert (np.abs(middle.value - [0.01, -0.02]) < 4.0 * middle.std).all() and middle.std.min() < 1e-3
    errors, covariance = off(result, simulation)
    check_near(errors)
    assert errors @ np.linalg.solve(covariance, errors) < chi2.ppf(0.999, 7)


def test_an_arm_before_an_edge_does_no_harm():
    """It covers 8 cm of the sheet at a third of the height of one edge."""
    simulation = simulate(scene(8.0, azimuth_steps=300, **OPEN), 3)
    (stream,), (sheet, at) = simulation.measurements.lidars, true_sheet(simulation)
    from_corner = (in_world(simulation)[0] - at) @ sheet.rotation - [*sheet.outline[1], 0.0]
    covered = (stream.plane < 0) & (from_corner[:, 0] > -0.08) & (np.abs(from_corner[:, 1] + 0.4) < 0.13)
    nearer = 1.0 - 0.2 * covered[:, None] / np.linalg.norm(stream.xyz, axis=1, keepdims=True)
    disturbed = simulation.measurements.with_streams(replace(stream, xyz=(stream.xyz * nearer).astype(np.float32)))
    errors, covariance = off(calibrated(replace(simulation, measurements=disturbed), 3), simulation)
    check_near(errors)
    assert errors @ np.linalg.solve(covariance, errors) < chi2.ppf(0.999, 7)


@pytest.mark.parametrize(("stated", "sentence"), [((0.9, 0.9), "farther in"), ((0.7, 0.7), "farther out")])
def test_a_wrong_size_of_the_sheet_is_named(stated, sentence):
    simulation = simulate(scene(6.0, azimuth_steps=300), 2)
    result = calibrated(simulation, 2, sheet=stated)
    assert sentence in named("sheet_size_wrong", result.warnings)
    errors, covariance = off(result, simulation)
    assert errors @ np.linalg.solve(covariance, errors) < chi2.ppf(0.999, 7)


@pytest.mark.full
@pytest.mark.parametrize("place", [{}, OPEN], ids=["room", "open place"])
def test_errors_are_as_large_as_their_standard_deviations(place):
    seeds = range(3)
    total = 0.0
    for seed in seeds:
        simulation = simulate(scene(30.0, **place), seed)
        errors, covariance = off(calibrated(simulation, seed), simulation)
        check_near(errors)
        total += errors @ np.linalg.solve(covariance, errors)
    low, high = chi2.ppf([0.005, 0.995], 7 * len(seeds))
    assert low < total < high
