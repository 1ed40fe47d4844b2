"""Every combination of sensors, from nothing and from guesses: correct, or refused with the true reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icalib.data.measurements import Measurements
from icalib.errors import CalibrationError
from icalib.geometry.targets import AprilGrid, Markers, NoTarget
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter, Rig
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.montecarlo.record import error, true_value
from icalib.tools.simulation import Features, Scenario, Simulation, load_scenario, rig_for, simulate, with_drawn_guess

PAPER = Path(__file__).parents[2] / "examples" / "paper"
SECONDS, SEED = 8.0, 5
BOARD = AprilGrid(4, 10, 0.6, 0.3)
ON_WALL = np.array([[0.0, 0.0, -1.0, 5.9], [-1.0, 0.0, 0.0, 3.9], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]])
TAG_M, TAGS_A_WALL = 0.4, 7
T_IMU_MOCAP = np.array([[0.36, 0.48, -0.8, 0.05], [-0.8, 0.6, 0.0, -0.1], [0.48, 0.64, 0.6, 0.2], [0.0, 0.0, 0.0, 1.0]])
MOCAP = SimPoses("mocap0", T_IMU_MOCAP, time_offset_s=0.006, rate_hz=50.0)
MOST_SIGMA = 5.0
# What no result that is called determined may be off by; distortions are left to the sigmas.
BOUNDS = {"rotation": 0.03, "translation": 0.1, "time_offset": 5e-3, "intrinsics": 5.0, "radii": 2e-3, "baseline": 0.02}
EXTRINSICS = ("rotation", "translation", "time_offset")
SEES, KNOWN = ("", "board", "tags", "tracks"), ("nothing", "extrinsics", "lenses")
OTHERS = ("lidar", "wheels", "pose")
SUBSETS = ["+".join(n for n, on in zip(OTHERS, bits, strict=True) if on) for bits in product((0, 1), repeat=3)]


def refusal(sees: str, imu: bool, others: str, known: str) -> str:
    """A part of the sentence that refuses a combination; empty where it is calibrated."""
    if not sees and others == "wheels":
        return "there is no camera, no LiDAR, no pose sensor and no position sensor"
    if not imu and not sees and others in ("lidar", "pose"):
        return "is the only sensor"
    if not imu and sees == "tracks" and not {"lidar", "pose"} & set(others.split("+")):
        return "determines the scale"
    return ""


def in_ci(sees: str, imu: bool, others: str, known: str) -> bool:
    """Pairs of sensors beside or without the IMU, from nothing, tracks with a guess of the lens, which is what takes
    long to find; all sensors together, from nothing."""
    count = bool(sees) + len(others.split("+") if others else ())
    if imu and sees == "board" and others == SUBSETS[-1]:
        return known == "nothing"
    return count <= 2 and known == ("lenses" if sees == "tracks" else "nothing")


def combinations() -> list[Any]:
    """All that have a sensor beside the IMU; those that are not `in_ci` are marked as full."""
    found = []
    for imu, sees, others, known in product((True, False), SEES, SUBSETS, KNOWN):
        if not (sees or others) or (known == "lenses" and not sees):
            continue
        name = "-".join([sees or "no camera", *(["imu"] if imu else []), *([others] if others else []), known])
        marks = [] if in_ci(sees, imu, others, known) else [pytest.mark.full]
        found.append(pytest.param(sees, imu, others, known, id=name, marks=marks))
    return found


@pytest.fixture(scope="module")
def recording(tags_on_walls: Callable) -> Callable[..., Simulation]:
    """The paper's robot on hills, of fewer points and images: one drive, before a board, tags or points."""
    base = load_scenario(PAPER / "table2-ramp.yaml")
    assert base.room is not None
    lidars = tuple(replace(x, azimuth_steps=100) for x in base.of(SimLidar))
    wheels = tuple(replace(w, noise=0.005, allowed_slip=1e-4) for w in base.of(SimWheels))
    robot = replace(
        base,
        duration_s=SECONDS,
        cameras=tuple(replace(c, rate_hz=8.0, phase_s=0.0, corner_noise_px=0.2) for c in base.cameras),
        sensors=(*lidars, *wheels, MOCAP),
        features=None,
    )
    tags = Markers("tag36h11", TAG_M, tuple(range(4 * TAGS_A_WALL)))
    bodies = tags_on_walls(base.room.size, TAGS_A_WALL)
    scenes: dict[str, Scenario] = {
        "board": replace(robot, cameras=robot.cameras[:1], target=BOARD, board=True, T_world_board=ON_WALL),
        "tags": replace(robot, cameras=robot.cameras[:1], target=tags, board=True, T_world_bodies=bodies),
        "tracks": replace(
            robot,
            cameras=robot.cameras[:1],
            target=NoTarget(),
            board=False,
            T_world_bodies=np.zeros((0, 4, 4)),
            features=Features(per_image=60, count=800),
        ),
    }
    made: dict[tuple[str, int], Simulation] = {}

    def of(sees: str, seed: int = SEED) -> Simulation:
        kind = sees or "board"
        if (kind, seed) not in made:
            made[kind, seed] = simulate(scenes[kind], seed)
        return made[kind, seed]

    return of


def rig_and_measurements(
    simulation: Simulation, sees: str, imu: bool, others: str, known: str
) -> tuple[Rig, Measurements]:
    scenario, m = simulation.scenario, simulation.measurements.unassociated()
    rig = rig_for(scenario, intrinsics="free", distortion="free")
    only = {"nothing": (), "extrinsics": EXTRINSICS, "lenses": ("intrinsics",)}[known]
    if sees == "tracks" and known == "extrinsics":
        only = (*only, "intrinsics")
    rig = with_drawn_guess(rig, scenario, SEED, only=only)
    if not sees:
        rig = rig.with_(cameras=(), target=NoTarget())
    unwanted = {"lidar", "wheels", "pose"} - set(others.split("+"))
    unused = [s.name for s in rig.sensors.values() if s.sensor_type in unwanted]
    rig = rig.without(*unused)
    if not imu:
        rig = in_body(rig.with_(imu=None), simulation)
    return rig, m.only(*rig.sensors)


def in_body(rig: Rig, simulation: Simulation) -> Rig:
    """The rig without an IMU, whose guesses are in the frame and on the clock of its body."""
    if not rig.cameras and not rig.poses and not rig.lidars:
        return rig
    T0, offset0 = body(rig, simulation)

    def moved(sensor: Any) -> Any:
        if sensor.name == rig.reference:
            return replace(sensor, **dict.fromkeys(EXTRINSICS, Parameter()))
        if sensor.rotation.value is None:
            return sensor
        R, p = T0[:3, :3].T @ sensor.rotation.value, T0[:3, :3].T @ (sensor.translation.value - T0[:3, 3])
        values = zip(EXTRINSICS, (R, p, sensor.time_offset.value - offset0), strict=True)
        return replace(sensor, **{name: Parameter("free", value) for name, value in values})

    kinds = ("cameras", "lidars", "wheels", "poses")
    return rig.with_(**{kind: tuple(moved(s) for s in getattr(rig, kind)) for kind in kinds})


def body(rig: Rig, simulation: Simulation) -> tuple[np.ndarray, float]:
    """T_imu_body and the body's time offset."""
    if rig.imu is not None:
        return np.eye(4), 0.0
    truth = simulation.truth
    return truth.T_imu_sensor[rig.reference], float(truth.time_offset[rig.reference])


def wrong(result: Calibration, rig: Rig, simulation: Simulation) -> list[str]:
    """What is called determined and off by more than its sigma or the bounds allow."""
    T0, offset0 = body(rig, simulation)
    found = []
    for g in result.groups:
        true = true_value(simulation.truth, g.sensor, g.name)
        if true is None or g.columns is None:
            continue
        if g.name == "rotation":
            true = T0[:3, :3].T @ true
        elif g.name == "translation":
            true = T0[:3, :3].T @ (true - T0[:3, 3])
        elif g.name == "time_offset":
            true = true - offset0
        known = np.array(g.verdict) == "determined"
        off = np.where(known, np.abs(error(g.name, g.value, true)), 0.0)
        sigma = np.sqrt(np.diag(result.covariance)[list(g.columns)])
        if (off > MOST_SIGMA * sigma).any() or off.max() > BOUNDS.get(g.name, np.inf):
            found.append(f"{g.sensor} {g.name} is off by {off}, sigma {sigma}")
    return found


@pytest.mark.parametrize(("sees", "imu", "others", "known"), combinations())
def test_correct_or_refused(recording, sees: str, imu: bool, others: str, known: str):
    simulation = recording(sees)
    rig, measurements = rig_and_measurements(simulation, sees, imu, others, known)
    expected = refusal(sees, imu, others, known)
    if expected:
        with pytest.raises(CalibrationError, match=expected):
            calibrate_measurements(rig, measurements)
        return
    result = calibrate_measurements(rig, measurements)
    assert result.converged, result.status
    assert wrong(result, rig, simulation) == []
    known_in_part = {g.sensor for g in result.groups if {"determined", "weak"} & {*g.verdict}}
    placed = {s.name for s in rig.mounted} - {rig.reference}
    assert placed <= known_in_part


@pytest.mark.parametrize("seed", [SEED, 8, 20])
def test_lidars_beside_tags_are_right_on_other_drives(recording, seed: int):
    """Of twenty drives: one on which hills bent the trajectory in the first round of association, one whose first
    images show only tags that are left out, and one on hills through which many beams of other walls pass."""
    simulation = recording("tags", seed)
    rig, measurements = rig_and_measurements(simulation, "tags", False, "lidar", "nothing")
    result = calibrate_measurements(rig, measurements)
    assert wrong(result, rig, simulation) == []
    offset = result.group("lidar0", "time_offset")
    true = float(simulation.truth.time_offset["lidar0"]) - body(rig, simulation)[1]
    assert abs(offset.value[0] - true) < 2.5 * offset.std[0]
