"""LiDARs in motion without an IMU: beside another LiDAR, wheels, motion capture, a camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.consistency.cases import Case, Check, body_is, known, notes, off_below, parameters, planes_found
from tests.consistency.recordings import make_robot, mocap, steady
from tests.typed import not_none

from icalib.data.measurements import Measurements
from icalib.rig import Rig
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.simulation import Scenario, Simulation, rig_for, simulate

ASIDE = np.array([[1.0, 0.0, 0.0, 0.25], [0.0, 0.8, -0.6, -0.1], [0.0, 0.6, 0.8, 0.1], [0.0, 0.0, 0.0, 1.0]])
SECONDS, STEPS = 8.0, 300
DEG, MM, MS = np.deg2rad(1.0), 1e-3, 1e-3


def ideal(scenario: Scenario) -> Simulation:
    """A recording of which the IMU is left out: its noise would be that of the motion."""
    return simulate(replace(scenario, imu_noise_enabled=False), 0)


def two_lidars() -> Scenario:
    scenario = make_robot("3d", SECONDS, "l", STEPS)
    (first,) = scenario.of(SimLidar)
    return scenario.with_sensors(replace(first, name="lidar1", T_imu_sensor=ASIDE, time_offset_s=0.03))


def on_its_side() -> Scenario:
    """Two LiDARs in a small room. The first hardly sees one pair of walls, and its odometry drifts by 0.6 m."""
    scenario = two_lidars()
    first, second = scenario.of(SimLidar)
    T = first.T_imu_sensor @ np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    small = replace(not_none(scenario.room), size=(6.0, 5.0, 2.6), blocks=())
    return replace(scenario.with_sensors(replace(first, T_imu_sensor=T), second), room=small)


def without_imu(simulation: Simulation) -> Rig:
    return steady(rig_for(simulation.scenario)).with_(imu=None)


def seen(simulation: Simulation) -> Measurements:
    return planes_found(simulation).without("imu0")


def near(sensor: str, degrees: float, mm: float, ms: float) -> list[Check]:
    bounds = {"rotation": degrees * DEG, "translation": mm * MM, "time_offset": ms * MS}
    return [known(), *(off_below(f"{sensor}.{name}", most) for name, most in bounds.items())]


CASES: dict[str, Case] = {
    "two LiDARs": Case(
        lambda: ideal(two_lidars()), [*near("lidar1", 0.05, 2.0, 0.2), body_is("lidar0")], without_imu, seen
    ),
    "LiDAR on its side": Case(
        lambda: ideal(on_its_side()),
        [*near("lidar0", 0.05, 2.0, 0.2), body_is("lidar0"), notes("motion_by_other_sensor")],
        without_imu,
        seen,
    ),
    "wheels": Case(
        lambda: ideal(make_robot("ramp", 12.0, "lw", STEPS)),
        [*near("wheel0", 1.0, 20.0, 2.0), body_is("lidar0")],
        without_imu,
        seen,
    ),
    "motion capture": Case(
        lambda: ideal(make_robot("3d", SECONDS, "l", STEPS).with_sensors(mocap(rate_hz=50.0))),
        [*near("mocap0", 0.05, 3.0, 0.3), body_is("lidar0")],
        without_imu,
        seen,
    ),
}


@pytest.mark.parametrize("case", parameters(CASES))
def test_a_case(case: Case) -> None:
    case.verify()
