"""Readings as slow as keyframes: the noise of one interval, and information of the calibration far from the origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.sensors.pose.test_pose_factor import pose
from tests.typed import instance, not_none

from icalib.estimate.estimate import MeasurementModel
from icalib.estimate.inputs import Inputs, inputs_for
from icalib.optim.arrowhead import solve
from icalib.optim.state import State
from icalib.sensors.imu.residual import ImuFactor
from icalib.sensors.pose.residual import FRAME, frame_of
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.simulation import Drive, Room, Scenario, rig_for, simulate

RATE_HZ = 25.0
FAR_M = 1000.0


@pytest.fixture(scope="module")
def truth() -> tuple[Inputs, State]:
    """40 s of poses at the stamps of an IMU, without noise, and the true state at these stamps."""
    mocap = SimPoses("mocap0", pose([0.3, -0.5, 1.0], [0.1, -0.2, 0.15]), rate_hz=RATE_HZ)
    scenario = Scenario(
        (),
        duration_s=40.0,
        motion=Drive("free"),
        board=False,
        room=Room((8.0, 6.0, 3.0)),
        sensors=(mocap,),
        imu_rate_hz=RATE_HZ,
        imu_noise_enabled=False,
        robot_noise_enabled=False,
    )
    sim = simulate(scenario, 5)
    rig = rig_for(scenario)
    inputs, imu, true = inputs_for(rig, [sim.measurements]), not_none(sim.measurements.imu), sim.truth
    late = true.time_offset["mocap0"] + (sim.measurements.poses[0].origin_ns - imu.origin_ns) * 1e-9
    values = {
        ("imu0", "intrinsics"): np.zeros(24),
        ("world", "gravity"): np.array([9.81]),
        ("mocap0", "scale"): np.ones(1),
        ("mocap0", "rotation"): mocap.T_imu_sensor[:3, :3].copy(),
        ("mocap0", "translation"): mocap.T_imu_sensor[:3, 3].copy(),
        ("mocap0", "time_offset"): np.array([late]),
        ("mocap0", "clock_rate"): np.zeros(1),
        (frame_of("mocap0", 0), FRAME[0]): np.eye(3),
        (frame_of("mocap0", 0), FRAME[1]): np.zeros(3),
    }
    keyframes = imu.seconds[5:-5]
    bias = np.tile(np.concatenate([true.gyro_bias[0], true.accel_bias[0]]), (len(keyframes), 1))
    return inputs, State(keyframes, *true.pose_at(keyframes + true.seconds[0]), bias, values)


def information(inputs: Inputs, state: State) -> np.ndarray:
    """Of the parameters of the pose sensor but scale, in units of the tolerances, all else marginalised."""
    problem = MeasurementModel.first(inputs).problem(inputs, state)
    pieces = problem.pieces()
    problem.linearise(state, pieces, problem.residuals())
    t = problem.tolerance
    whole = solve(pieces, problem.n_keyframes, t).information * t[:, None] * t
    kept = inputs.layout.columns("mocap0", "rotation", "translation", "time_offset")
    others = np.setdiff1d(np.arange(len(t)), kept)
    cross = whole[np.ix_(kept, others)]
    return whole[np.ix_(kept, kept)] - cross @ np.linalg.solve(whole[np.ix_(others, others)], cross.T)


def test_noise_of_one_interval_is_white_in_continuous_time(truth):
    """Velocity and position are the first two integrals of white noise of density n: n^2 (T, T^2 / 2, T^3 / 3)."""
    inputs, state = truth
    W = instance(MeasurementModel.first(inputs).problem(inputs, state).chain, ImuFactor).increments.W[7]
    covariance = np.linalg.inv(W.T @ W)
    n, T = not_none(inputs.rig.imu).noise.accel, 1.0 / RATE_HZ
    expected = n**2 * np.array([[T, T**2 / 2.0], [T**2 / 2.0, T**3 / 3.0]])
    for i in range(3):
        axes = [3 + i, 6 + i]
        np.testing.assert_allclose(covariance[np.ix_(axes, axes)], expected, rtol=0.02)


def test_information_does_not_depend_on_the_origin_of_the_world(truth):
    """Rounding errors of the normal equations grow with the information of one interval. With noise that is constant
    between readings they are 1e-6 here, and beyond all information in a drive of 450 s."""
    inputs, state = truth
    here = information(inputs, state)
    frame, away = (frame_of("mocap0", 0), FRAME[1]), np.array([FAR_M, 0.0, 0.0])
    far = replace(state, position=state.position + away, values=state.values | {frame: away})
    root = np.linalg.inv(np.linalg.cholesky(here))
    ratios = np.linalg.eigvalsh(root @ information(inputs, far) @ root.T)
    np.testing.assert_allclose(ratios, 1.0, atol=1e-8)
