"""Relative planar poses of a frame, as the paper's (27) has them: mount and time offset from nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.motion.imu_data import ImuData
from icalib.sensors.wheels.initialize import extrinsics_guess, intervals_inside, poses_offset
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import load_scenario, simulate

PAPER = Path(__file__).parents[3] / "examples" / "paper"


@pytest.fixture(scope="module")
def free_motion():
    scenario = load_scenario(PAPER / "table2-3d.yaml")
    wheels = replace(scenario.of(SimWheels)[0], time_offset_s=0.034, clock_origin_ns=7_000_000_000, phase_s=3.0)
    return simulate(replace(scenario, duration_s=30.0, cameras=(), features=None, sensors=(wheels,)), 4)


def setting(sim):
    imu, stream = sim.measurements.imu, sim.measurements.wheels[0]
    true = sim.truth.time_offset["wheel0"] + (stream.origin_ns - imu.origin_ns) * 1e-9
    return ImuData.build(imu, sim.scenario.imu_noise), stream, true


def test_time_offset(free_motion):
    """In free motion the yaw of (27) is not quite the integral of a rate about one axis."""
    imu, stream, true = setting(free_motion)
    assert poses_offset(imu, stream) == pytest.approx(true, abs=5e-3)


def test_extrinsics(free_motion):
    imu, stream, offset = setting(free_motion)
    inside = intervals_inside(imu, stream, offset)
    t = (0.5 * (stream.seconds[1:] + stream.seconds[:-1]) + offset)[inside] + free_motion.truth.seconds[0]
    R, _, velocity = free_motion.truth.pose_at(t)
    rate = free_motion.truth.trajectory.rate_at(t)
    found = extrinsics_guess(stream, inside, rate, np.einsum("nji,nj->ni", R, velocity))
    T = free_motion.truth.T_imu_sensor["wheel0"]
    turn = so3.log(np.ascontiguousarray(T[:3, :3].T @ found.R))
    assert np.abs(np.rad2deg(turn)).max() < 1.0
    assert np.abs(found.p - T[:3, 3]).max() < 0.02


def test_a_frame_of_another_recording_is_refused(free_motion):
    imu, stream, _ = setting(free_motion)
    rng = np.random.default_rng(0)
    pose = np.column_stack([0.02 * rng.normal(size=len(stream.pose)), stream.pose[:, 1:]])
    with pytest.raises(EstimationError, match="wheel0 does not match that of imu0 at any time offset"):
        poses_offset(imu, replace(stream, pose=pose))
