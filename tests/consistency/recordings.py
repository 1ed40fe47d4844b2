"""Recordings and rig files that several files of this folder simulate."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from tests.typed import not_none

from icalib.data.measurements import Measurements
from icalib.geometry.targets import AprilGrid, NoTarget
from icalib.rig import Rig, WheelKind
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import Scenario, Simulation, handheld, load_scenario, rig_for, simulate

PAPER = Path(__file__).parents[2] / "examples" / "paper"
MOUNTS = ("rotation", "translation", "time_offset")
WALL_GRID = AprilGrid(4, 10, 0.6, 0.3)
ENCODER = 0.005  # rad/sqrt(s), a good one's: with the paper's 0.03 it is chance whether hills show how wheels roll
STEADY = 1e-4  # m/sqrt(s): simulated wheels do not slip
ON_WALL = np.array([[0.0, 0.0, -1.0, 5.9], [-1.0, 0.0, 0.0, 3.9], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]])
T_IMU_MOCAP = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.05], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
T_OTHER = np.array([[0.0, 0.0, 1.0, -0.2], [1.0, 0.0, 0.0, 0.3], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]])
WHEEL_KINDS: dict[str, WheelKind] = {"twist": "twist", "steering": "steered"}


@cache
def by_hand(seconds: float, seed: int) -> Simulation:
    """Two cameras and an IMU, moved by hand before a target."""
    return simulate(handheld(seconds), seed)


def make_robot(example: str, seconds: float, parts: str, azimuth_steps: int = 150, **changes) -> Scenario:
    """The paper's robot with some of its `parts`: c a camera and a wall of tags, l a LiDAR of few points, w wheels."""
    scenario = load_scenario(PAPER / f"table2-{example}.yaml")
    lidars = tuple(replace(x, azimuth_steps=azimuth_steps) for x in scenario.of(SimLidar) if "l" in parts)
    wheels = tuple(replace(w, noise=ENCODER) for w in scenario.of(SimWheels) if "w" in parts)
    camera = replace(scenario.cameras[0], corner_noise_px=0.15)
    board = {"board": True, "T_world_board": ON_WALL, "target": WALL_GRID}
    if "c" not in parts:
        board = {"board": False, "target": NoTarget(), "T_world_bodies": np.zeros((0, 4, 4))}
    return replace(
        scenario,
        duration_s=seconds,
        features=None,
        cameras=(camera,) if "c" in parts else (),
        sensors=(*lidars, *wheels),
        **board,
        **changes,
    )


def moving(scenario: Scenario, kind: str, **changes) -> Scenario:
    """The scenario with another motion."""
    return replace(scenario, motion=replace(scenario.motion, kind=kind, **changes))


def mocap(name: str = "mocap0", T: np.ndarray = T_IMU_MOCAP, **others) -> SimPoses:
    """With a frame that is tilted by a quarter turn: nothing says where up is."""
    tilted = np.array([[1.0, 0.0, 0.0, 2.0], [0.0, 0.0, -1.0, 1.0], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0]])
    usual = {"rotation_noise": 1e-3, "position_noise": 5e-4, "time_offset_s": 0.004, "clock_origin_ns": 5_000_000_000}
    return SimPoses(name, T, T_world_frame=tilted, **usual | others)


def ideal_imu(scenario: Scenario, seed: int = 0) -> Simulation:
    """A recording of which the IMU is left out: its noise would be that of the motion."""
    return simulate(replace(scenario, imu_noise_enabled=False), seed)


def without_imu(scenario: Scenario, seed: int = 0) -> tuple[Rig, Measurements, Simulation]:
    simulation = ideal_imu(scenario, seed)
    return rig_for(scenario).with_(imu=None), simulation.measurements.without("imu0"), simulation


def steady(rig: Rig) -> Rig:
    """The rig, its wheels as free of slip as simulated ones."""
    return rig.with_(wheels=tuple(replace(w, lateral_slip=STEADY, vertical_slip=STEADY) for w in rig.wheels))


def reporting(scenario: Scenario, reports: str) -> Scenario:
    """Its wheels as good as the encoders of the other tests, with parameters that are not the defaults."""
    changed = replace(
        scenario.of(SimWheels)[0],
        reports=reports,
        scales=(1.03, 0.97),
        speed_noise=5e-4,
        yaw_noise=2e-3,
        wheelbase=0.25,
        steering_offset=0.02,
        steering_noise=5e-4,
    )
    return scenario.with_sensors(changed)


def thin(motion: str, noise: float, seconds: float = 8.0) -> Scenario:
    """A little of the example's motion with few points, and an IMU `noise` times as noisy as its data sheet says."""
    scenario = load_scenario(PAPER / f"{motion}.yaml")
    return replace(
        scenario.with_sensors(*(replace(x, azimuth_steps=300) for x in scenario.of(SimLidar))),
        duration_s=seconds,
        imu_noise=scenario.imu_noise.scaled(noise),
        features=replace(not_none(scenario.features), per_image=30, count=450, persistent=60),
    )
