"""A pose sensor's first guess: with the IMU alone, and on a motion that is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.estimate.inputs import inputs_for
from icalib.optim.state import State
from icalib.sensors.parameter import Parameter, fixed
from icalib.sensors.pose.initialize import pose_rates, pose_values, state_from_poses
from icalib.sensors.pose.residual import FRAME, frame_of
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.simulation import Drive, Room, Scenario, rig_for, simulate

# Twice the worst of five seeds: rotation [deg], translation [m], time offset [s].
ALONE = {"absolute": (0.16, 8e-3, 6e-4), "relative": (0.8, 0.08, 5e-3)}
KNOWN = {"absolute": (0.12, 1e-3, 6e-4), "relative": (0.8, 0.05, 5e-3)}


def pose(vector, position):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(vector).as_matrix(), position
    return T


@pytest.fixture(scope="module", params=["absolute", "relative"])
def sim(request):
    noise = {"absolute": (2e-3, 1e-3), "relative": (5e-3, 1e-2)}[request.param]
    mocap = SimPoses(
        "mocap0",
        pose([2.0, -0.5, 1.0], [0.1, -0.2, 0.15]),
        kind=request.param,
        T_world_frame=pose([0.4, 0.1, 2.0], [3.0, -1.0, 0.5]),
        time_offset_s=0.5,
        rate_hz=50.0,
        clock_origin_ns=777,
        rotation_noise=noise[0],
        position_noise=noise[1],
    )
    scenario = Scenario(
        (), duration_s=15.0, motion=Drive("free"), board=False, room=Room((8.0, 6.0, 3.0)), sensors=(mocap,)
    )
    return simulate(scenario, 4)


def errors(sim, values):
    """Of rotation [deg], translation [m], time offset [s]."""
    T = sim.truth.T_imu_sensor["mocap0"]
    turn = Rotation.from_matrix(T[:3, :3].T @ values["mocap0", "rotation"]).magnitude()
    (stream,) = sim.measurements.poses
    offset = sim.truth.time_offset["mocap0"] + (stream.origin_ns - sim.measurements.imu.origin_ns) * 1e-9
    way = np.linalg.norm(values["mocap0", "translation"] - T[:3, 3])
    return np.rad2deg(turn), way, abs(values["mocap0", "time_offset"][0] - offset)


def truth_at(sim, keyframes):
    bias = np.concatenate([sim.truth.gyro_bias.mean(axis=0), sim.truth.accel_bias.mean(axis=0)])
    R, p, v = sim.truth.pose_at(keyframes + sim.truth.seconds[0])
    return State(keyframes, R, p, v, np.tile(bias, (len(keyframes), 1)), {("imu0", "intrinsics"): np.zeros(24)})


def test_with_the_imu_alone(sim):
    """And the motion: gravity points down, velocities are those of the truth but for the direction of the world's x."""
    inputs = inputs_for(rig_for(sim.scenario), [sim.measurements])
    state = state_from_poses(inputs)
    assert (np.array(errors(sim, state.values)) < ALONE[sim.scenario.of(SimPoses)[0].kind]).all()
    truth = truth_at(sim, state.seconds)
    tilt = np.einsum("nij,i->nj", state.rotation, [0.0, 0.0, 1.0]) - truth.rotation[:, 2]
    assert np.abs(tilt).max() < 0.06
    speeds = [np.linalg.norm(s.velocity, axis=1) for s in (state, truth)]
    assert np.sqrt(np.mean((speeds[0] - speeds[1]) ** 2)) < 0.05


def test_on_a_motion_that_is_known(sim):
    inputs = inputs_for(rig_for(sim.scenario), [sim.measurements])
    found = pose_values(inputs, truth_at(sim, np.arange(0.0, 14.9, 0.05)), inputs.rig.poses)
    assert (np.array(errors(sim, found)) < KNOWN[sim.scenario.of(SimPoses)[0].kind]).all()
    frame = frame_of("mocap0", 0)
    if sim.scenario.of(SimPoses)[0].kind == "relative":
        assert (frame, FRAME[0]) not in found
        return
    T = sim.scenario.of(SimPoses)[0].T_world_frame
    assert np.rad2deg(Rotation.from_matrix(T[:3, :3].T @ found[frame, FRAME[0]]).magnitude()) < 0.3
    assert np.linalg.norm(found[frame, FRAME[1]] - T[:3, 3]) < 0.05


@pytest.mark.parametrize("sim", ["absolute"], indirect=True)
def test_noise_of_rotations_does_not_shorten_the_lever_arm(sim):
    """It stands in the coefficients of the arm; taken as they come, poses of half that noise shorten it by up
    to 40 %."""
    (stream,), rng = sim.measurements.poses, np.random.default_rng(0)
    turns = Rotation.from_rotvec(4e-3 * rng.normal(size=(len(stream.stamps_ns), 3))).as_matrix()
    noisy = replace(stream, rotation=stream.rotation @ turns)
    inputs = inputs_for(rig_for(sim.scenario), [sim.measurements.with_streams(noisy)])
    assert errors(sim, state_from_poses(inputs).values)[1] < 0.02


def test_what_the_rig_gives_is_taken(sim):
    rig, T = rig_for(sim.scenario), sim.truth.T_imu_sensor["mocap0"]
    given = {
        "rotation": Parameter("free", T[:3, :3]),
        "translation": fixed([0.5, 0.0, 0.0]),
        "time_offset": fixed([sim.truth.time_offset["mocap0"]]),
    }
    inputs = inputs_for(rig.with_(poses=(replace(rig.poses[0], **given),)), [sim.measurements])
    values = state_from_poses(inputs).values
    np.testing.assert_array_equal(values["mocap0", "rotation"], T[:3, :3])
    np.testing.assert_array_equal(values["mocap0", "translation"], [0.5, 0.0, 0.0])
    assert errors(sim, values)[2] < 1e-9


def test_rates_are_means_over_windows(sim):
    (stream,) = sim.measurements.poses
    rates = pose_rates(stream)
    np.testing.assert_allclose(rates.end - rates.start, 0.1, atol=1e-6)
    np.testing.assert_allclose(np.diff(rates.start), 0.02, atol=1e-6)
    middle = 0.5 * (rates.start + rates.end) + sim.truth.time_offset["mocap0"]
    seconds = middle + (stream.origin_ns - sim.truth.imu_clock_origin_ns) * 1e-9
    imu = sim.measurements.imu
    at = (imu.stamps_ns - sim.truth.imu_clock_origin_ns) * 1e-9
    gyro = np.stack([np.interp(seconds, at, w) for w in (imu.gyro - sim.truth.gyro_bias).T], axis=1)
    seen = rates.rate @ sim.truth.T_imu_sensor["mocap0"][:3, :3].T
    assert np.sqrt(np.mean((seen - gyro) ** 2)) < 0.05
