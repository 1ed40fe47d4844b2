"""Bad input from LiDARs and wheels: one sentence, or a warning that says what is wrong."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from tests.remarks import named, names
from tests.typed import not_none

from icalib.data.measurements import LidarStream, Measurements, WheelStream
from icalib.errors import CalibrationError, EstimationError
from icalib.geometry import so3
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.result.verdict import UNUSABLE
from icalib.rig import Rig
from icalib.sensors.lidar.initialize import association as association_rounds
from icalib.tools.montecarlo.record import true_value
from icalib.tools.simulation import Simulation, rig_for, simulate, with_drawn_guess

MOUNTS = ("rotation", "translation", "time_offset")
SCAN_S = 0.125
Damage = Callable[[LidarStream], LidarStream]


@pytest.fixture(scope="module")
def drive(robot):
    """A simulated drive: the paper's example, its length, what stands on the robot, how it moves if not as there."""

    @cache
    def run(example: str, seconds: float, parts: str, kind: str = "") -> Simulation:
        scenario = robot(example, seconds, parts, 300)
        if kind:
            scenario = replace(scenario, motion=replace(scenario.motion, kind=kind))
        return simulate(scenario, 1)

    return run


def guessed(simulation: Simulation) -> Rig:
    return with_drawn_guess(rig_for(simulation.scenario), simulation.scenario, 1, only=MOUNTS)


def with_wheels(measurements: Measurements, damage: Callable[[WheelStream], WheelStream]) -> Measurements:
    return measurements.with_streams(*(damage(w) for w in measurements.wheels if isinstance(w, WheelStream)))


def with_scans(measurements: Measurements, damage: Damage) -> Measurements:
    """Damaged scans, of which nobody knows what lies on which plane."""
    damaged = (damage(x) for x in measurements.lidars)
    return measurements.with_streams(*(replace(x, plane=np.full(len(x.xyz), -1, np.int32)) for x in damaged))


def refusal(rig: Rig, measurements: Measurements) -> str:
    with pytest.raises(CalibrationError) as caught:
        calibrate_measurements(rig, measurements)
    return str(caught.value)


TURNED = [
    (lambda rate: rate * [1.0, -1.0], "wheel0.*opposite directions"),
    (lambda rate: -rate, "wheel0.*swapped, or both count backwards"),
    pytest.param(lambda rate: rate[:, ::-1].copy(), "wheel0.*swapped, or both count backwards", marks=pytest.mark.full),
    (lambda rate: rate * [1.0, 0.0], "wheel0.*the right wheel did not turn"),
    pytest.param(lambda rate: rate * 0.0, "wheel0.*the left and the right wheel did not turn", marks=pytest.mark.full),
    (lambda rate: np.rad2deg(rate), "wheel0.*radii of 0.00.*not degrees"),
    (lambda rate: np.random.default_rng(0).normal(size=rate.shape), "wheel0 does not match that of imu0"),
]


@pytest.mark.parametrize(("damage", "words"), TURNED)
def test_wheels_that_cannot_be(drive, damage, words: str):
    simulation = drive("ramp", 16.0, "cw")
    broken = with_wheels(simulation.measurements, lambda w: replace(w, rate=damage(w.rate)))
    with pytest.raises(CalibrationError, match=words):
        calibrate_measurements(rig_for(simulation.scenario), broken)


def test_wheels_that_never_turned_while_the_camera_looked(drive):
    """At a stated offset none of their readings can be used; a guess of it is replaced by what the motion shows."""
    simulation = drive("ramp", 16.0, "cw")
    late = with_wheels(simulation.measurements, lambda w: replace(w, stamps_ns=w.stamps_ns + np.int64(10**12)))
    rig = guessed(simulation)
    stated = tuple(replace(w, time_offset=replace(w.time_offset, mode="fixed")) for w in rig.wheels)
    words = refusal(rig.with_(wheels=stated), late)
    assert re.search(r"fixed value of time offset of wheel0.*-999999\.9", words), words
    result = calibrate_measurements(rig, late)
    offset = not_none(true_value(simulation.truth, "wheel0", "time_offset"))[0] - 1000.0
    assert result.group("wheel0", "time_offset").value[0] == pytest.approx(offset, abs=2e-3)
    assert any("time offset of wheel0" in note for note in result.notes if note.name == "guess_contradicted")


@pytest.mark.parametrize(
    ("kind", "parts", "words"),
    [
        ("straight-line", "cw", "wheel0: the vehicle turned at 0.00"),
        ("arc", "cw", "drove a single arc"),
        ("standing", "cw", "motionless|hardly turn"),
        pytest.param("standing", "lw", "hardly turn", marks=pytest.mark.full),
        pytest.param("arc", "lw", "drove a single arc", marks=pytest.mark.full),
        ("planar", "w", "wheel0 and imu0 do not determine the motion"),
    ],
)
def test_drives_that_show_too_little(drive, kind: str, parts: str, words: str):
    simulation = drive("planar", 16.0, parts, kind)
    rig = rig_for(simulation.scenario) if kind == "standing" else guessed(simulation)
    with pytest.raises(CalibrationError, match=words):
        calibrate_measurements(rig, simulation.measurements)


def open_field(x: LidarStream) -> LidarStream:
    return replace(x, xyz=np.random.default_rng(0).normal(scale=15.0, size=x.xyz.shape).astype(np.float32))


def seeing(faces: list[int], x: LidarStream) -> LidarStream:
    """Nothing but some faces of the room: 0 the floor, 1 the ceiling, 2 and 3, 4 and 5 walls that face each other."""
    own = np.isin(x.plane, faces)
    start = np.concatenate([[0], np.cumsum(own)])[x.start].astype(np.int64)
    return LidarStream(x.name, x.stamps_ns, start, x.offset_s[own], x.xyz[own], x.plane[own])


def mirrored(x: LidarStream) -> LidarStream:
    return replace(x, xyz=x.xyz * np.array([1.0, -1.0, 1.0], np.float32))


def milliseconds(x: LidarStream) -> LidarStream:
    return replace(x, offset_s=x.offset_s * np.float32(1e3))


SEEN: list[Any] = [
    (open_field, "lidar0.*too few flat surfaces"),
    *(
        pytest.param(
            partial(seeing, faces), "surfaces that lidar0 sees face one direction only", marks=pytest.mark.full
        )
        for faces in ([2], [0])
    ),
    (partial(seeing, [2, 3]), "surfaces that lidar0 sees face one direction only"),
    (mirrored, "lidar0 turns as imu0 does, but moves the other way"),
    (milliseconds, "lidar0.*point times may be wrong"),
]


@pytest.mark.parametrize(("damage", "words"), SEEN)
def test_clouds_that_cannot_be(drive, damage: Damage, words: str):
    simulation = drive("3d", 12.0, "l")
    with pytest.raises(CalibrationError, match=words):
        calibrate_measurements(rig_for(simulation.scenario), with_scans(simulation.measurements, damage))


@pytest.mark.full
@pytest.mark.parametrize("faces", [[0], [2, 3]])
def test_too_few_surfaces_with_a_guess(drive, faces: list[int]):
    simulation = drive("3d", 12.0, "l")
    broken = with_scans(simulation.measurements, partial(seeing, faces))
    assert "surfaces that lidar0 sees face" in refusal(guessed(simulation), broken)


@pytest.mark.parametrize(
    ("faces", "known"),
    [pytest.param(f, k, marks=pytest.mark.full) for f in ([0, 2, 3], [0, 2]) for k in (True, False)],
)
def test_a_corridor_is_told(drive, faces: list[int], known: bool):
    """One or two walls and a floor leave the motion along them open. Whether the IMU carries the solver through is a
    matter of luck: it ends in words, or in a result that says so and calls nothing determined that is wrong."""
    simulation = drive("3d", 12.0, "l")
    corridor = with_scans(simulation.measurements, partial(seeing, faces))
    try:
        result = calibrate_measurements(guessed(simulation) if known else rig_for(simulation.scenario), corridor)
    except CalibrationError as refused:
        assert "surfaces that lidar0 sees face two directions only, as in a corridor" in str(refused)
        return
    assert "lidar0" in named("scene_like_corridor", result.warnings)
    translation = result.group("lidar0", "translation")
    sure = np.array([v not in UNUSABLE for v in translation.verdict])
    off = translation.value - simulation.truth.T_imu_sensor["lidar0"][:3, 3]
    assert (np.abs(off) < 4.0 * translation.std)[sure].all()


def test_a_corridor_is_told_where_no_plane_is_found_any_more(drive, monkeypatch):
    """Along a corridor the estimate may lead so far away that walls are no walls in the next round."""
    simulation = drive("3d", 12.0, "l")
    corridor = with_scans(simulation.measurements, partial(seeing, [0, 2]))

    def nothing(*_):
        raise EstimationError("lidar0 saw no flat surface of 0.7 m^2 or more.")

    monkeypatch.setattr(association_rounds, "associate", nothing)
    assert "surfaces that lidar0 sees face two directions only" in refusal(guessed(simulation), corridor)
    assert "lidar0 saw no flat surface" in refusal(guessed(simulation), simulation.measurements.unassociated())


def calibrated(simulation: Simulation, damage: Damage) -> Calibration:
    return calibrate_measurements(rig_for(simulation.scenario), with_scans(simulation.measurements, damage))


def test_points_without_numbers_and_at_zero_are_left_out(drive):
    def damage(x: LidarStream) -> LidarStream:
        xyz = x.xyz.copy()
        xyz[::7], xyz[::11] = np.nan, 0.0
        return replace(x, xyz=xyz)

    simulation = drive("3d", 12.0, "l")
    result = calibrated(simulation, damage)
    assert result.converged and "scene_like_corridor" not in names(result.warnings)
    off = result.group("lidar0", "translation").value - simulation.truth.T_imu_sensor["lidar0"][:3, 3]
    assert np.linalg.norm(off) < 5e-3


def test_points_on_the_robot_itself_are_left_out_and_told(drive):
    """A panel 0.9 m ahead, in a quarter of the points. Left in, they made the rotation wrong by 31 standard deviations,
    the translation by 42."""

    def damage(x: LidarStream) -> LidarStream:
        distance = 0.9 / np.maximum(x.xyz[:, 0], 1e-6)
        at = distance[:, None] * x.xyz
        hit = (distance < 1.0) & (np.abs(at[:, 1]) < 1.0) & (at[:, 2] > -0.6) & (at[:, 2] < 0.3)
        blur = 1.0 + 0.03 * np.random.default_rng(0).standard_normal(len(at)) / np.linalg.norm(at, axis=1)
        return replace(x, xyz=np.where(hit[:, None], blur[:, None] * at, x.xyz).astype(np.float32))

    simulation = drive("3d", 12.0, "l")
    result = calibrated(simulation, damage)
    assert result.converged and "self_returns_removed" in names(result.warnings)
    truth = simulation.truth.T_imu_sensor["lidar0"]
    off = {"rotation": np.zeros(3), "translation": result.group("lidar0", "translation").value - truth[:3, 3]}
    off["rotation"] = so3.log(np.ascontiguousarray(truth[:3, :3].T @ result.group("lidar0", "rotation").value))
    for name, error in off.items():
        assert (np.abs(error) < 4.0 * result.group("lidar0", name).std).all(), name


def test_stamps_of_the_end_of_scans_are_told(drive):
    def damage(x: LidarStream) -> LidarStream:
        return replace(x, stamps_ns=x.stamps_ns + np.int64(SCAN_S * 1e9))

    result = calibrated(drive("3d", 12.0, "l"), damage)
    assert "stamps_at_scan_end" in names(result.warnings)


@pytest.mark.parametrize(
    ("factor", "words"),
    [(0.5, "too short"), *(pytest.param(*x, marks=pytest.mark.full) for x in ((1.0, ""), (2.0, "too long")))],
)
def test_times_of_points_that_are_stretched_are_told(drive, factor: float, words: str):
    """The time between scans does not tell: some LiDARs look to one side only, others overlap."""
    result = calibrated(drive("3d", 12.0, "l"), lambda x: replace(x, offset_s=x.offset_s * np.float32(factor)))
    said = [w for w in result.warnings if w.name == "scan_times_wrong"]
    assert len(said) == bool(words) and all(words in w for w in said)


@pytest.mark.full
def test_points_in_the_reverse_order_are_told(drive):
    """Most of them lie on no plane; nothing in the numbers alone would say so."""

    def damage(x: LidarStream) -> LidarStream:
        return replace(x, offset_s=np.float32(SCAN_S) - x.offset_s)

    simulation = drive("3d", 12.0, "l")
    try:
        result = calibrate_measurements(guessed(simulation), with_scans(simulation.measurements, damage))
    except CalibrationError as error:
        assert "lidar0" in str(error)
    else:
        assert "few_lidar_points_on_planes" in names(result.warnings)
