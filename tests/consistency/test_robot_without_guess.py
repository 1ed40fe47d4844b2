"""Cameras beside a LiDAR on a robot, nothing known of where they are, nor which point lies on which plane: the LiDAR
shows the motion, also where the robot turns about one axis and cameras by themselves show no guess.

From tracks alone such cameras are refused in the plane, and elsewhere now and then placed so badly that the answer is
100 standard deviations off.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icalib.errors import EstimationError
from icalib.initialize.rig_guess import guess_of_rig
from icalib.result.verdict import UNUSABLE
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.montecarlo.record import RunTask, run
from icalib.tools.montecarlo.summary import Sample, nees
from icalib.tools.simulation import Scenario, load_scenario, rig_for, simulate

PAPER = Path(__file__).parents[2] / "examples" / "paper"


def check(scenario: Scenario, seed: int, flat: bool) -> None:
    """All but heights over a flat floor is known, and as well as it is said to be."""
    record = run(RunTask(scenario, seed, planes="found"))
    assert not record.failure
    assert bool(record.unobservable) == flat
    assert all("translation z" in words for words in record.unobservable)
    known = np.concatenate([~np.isin(np.array(b.verdict), UNUSABLE) for b in record.blocks])
    found = nees([Sample(seed, record.error[known], record.covariance[np.ix_(known, known)])], 0.9999)
    assert found.consistent, found


@pytest.mark.parametrize(("example", "seed"), [("planar", 4000), ("ramp", 4000)])
def test_cameras_that_follow_points(example, seed):
    scenario = load_scenario(PAPER / f"table2-{example}.yaml")
    lidars = tuple(replace(x, azimuth_steps=300) for x in scenario.of(SimLidar))
    scenario = replace(scenario, duration_s=20.0, cameras=scenario.cameras[:2], sensors=lidars)
    check(scenario, seed, example == "planar")


def test_a_camera_that_sees_a_target_from_a_flat_floor(robot):
    check(robot("planar", 20.0, "cl", 300), 4, True)


def test_motion_capture_shows_it_as_well(robot):
    mocap = SimPoses("mocap0", np.eye(4), rotation_noise=1e-3, position_noise=5e-4)
    check(robot("planar", 20.0, "c").with_sensors(mocap), 4, True)


def test_where_the_lidar_shows_nothing_either_the_camera_says_what_is_missing(robot):
    scenario = robot("planar", 20.0, "cl", 100)
    seen = simulate(scenario, 4).measurements.unassociated()
    (lidar,) = seen.lidars
    scattered = np.random.default_rng(0).uniform(-20.0, 20.0, lidar.xyz.shape).astype(np.float32)
    with pytest.raises(EstimationError, match="cam0 turned about one axis only"):
        guess_of_rig(rig_for(scenario), [seen.with_streams(replace(lidar, xyz=scattered))])
