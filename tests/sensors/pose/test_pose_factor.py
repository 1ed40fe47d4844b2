"""Pose sensors against simulated poses: the sign of residuals, which poses are used, and in which frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.typed import not_none

from icalib.data.measurements import PoseStream
from icalib.estimate.inputs import inputs_for
from icalib.estimate.problem import pass_at
from icalib.motion.factor import Frame, absolute_residuals, relative_residuals
from icalib.optim.arrowhead import make_pieces
from icalib.optim.state import State
from icalib.rig import PoseSensor
from icalib.sensors.pose.model import MODEL, estimated_noise
from icalib.sensors.pose.residual import FRAME, PoseNoise, RelativePosesFactor, frame_of
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.simulation import Drive, Room, Scenario, rig_for, simulate


def pose(vector, position):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(vector).as_matrix(), position
    return T


@pytest.fixture(scope="module", params=["absolute", "relative"])
def world(request):
    """Four seconds without noise, keyframes every 20 ms at the truth: inputs, state, stream."""
    mocap = SimPoses(
        "mocap0",
        pose([0.3, -0.5, 1.0], [0.1, -0.2, 0.15]),
        kind=request.param,
        T_world_frame=pose([0.2, 0.1, 2.0], [3.0, -1.0, 0.5]),
        time_offset_s=0.0123,
        clock_origin_ns=777,
        scale=1.02,
    )
    drive = Drive("free")
    scenario = Scenario(
        (),
        duration_s=4.0,
        motion=drive,
        board=False,
        room=Room((8.0, 6.0, 3.0)),
        sensors=(mocap,),
        imu_noise_enabled=False,
        robot_noise_enabled=False,
    )
    sim = simulate(scenario, 5)
    inputs = inputs_for(rig_for(scenario), [sim.measurements])
    (stream,), truth = sim.measurements.poses, sim.truth
    origins_s = (stream.origin_ns - not_none(sim.measurements.imu).origin_ns) * 1e-9
    values = {
        ("imu0", "intrinsics"): np.zeros(24),
        ("world", "gravity"): np.array([9.81]),
        ("mocap0", "scale"): np.array([mocap.scale]),
        ("mocap0", "rotation"): mocap.T_imu_sensor[:3, :3].copy(),
        ("mocap0", "translation"): mocap.T_imu_sensor[:3, 3].copy(),
        ("mocap0", "time_offset"): np.array([truth.time_offset["mocap0"] + origins_s]),
        (frame_of("mocap0", 0), FRAME[0]): mocap.T_world_frame[:3, :3].copy(),
        (frame_of("mocap0", 0), FRAME[1]): mocap.T_world_frame[:3, 3].copy(),
    }
    keyframes = np.arange(0.0, not_none(sim.measurements.imu).seconds[-1], 0.02)
    bias = np.concatenate([truth.gyro_bias[0], truth.accel_bias[0]])
    state = State(keyframes, *truth.pose_at(keyframes + truth.seconds[0]), np.tile(bias, (len(keyframes), 1)), values)
    return inputs, state, stream


def rows(inputs, state, stream, at=None):
    """Residuals before whitening (n, 6) of the factor built at `state`, evaluated there or at another."""
    sensor = inputs.rig.poses[0]
    frozen = pass_at(inputs, state)
    (factor,) = MODEL.factors(sensor, stream, PoseNoise(1e-3, 2e-3), frozen)
    out = factor.output()
    for piece in make_pieces(len(state.seconds), inputs.layout.size):
        factor.accumulate(at or state, piece, out, sums=False)
    return factor, out.residual * factor.sigma


def last_of_a_row(inputs, state, stream):
    """The number of a pose that a row in the middle ends with."""
    factor, _ = rows(inputs, state, stream)
    return int(factor.intervals.last[100]) if isinstance(factor, RelativePosesFactor) else 200


def test_truth_leaves_nothing(world):
    factor, residual = rows(*world)
    assert len(residual) > 190
    assert np.abs(residual).max() < 1e-7


def test_a_pose_that_is_moved_lowers_its_residual(world):
    """By what it is moved, in the frame's axes, or in the sensor's at the stretch's beginning."""
    inputs, state, stream = world
    k, by = last_of_a_row(*world), np.array([0.01, -0.02, 0.03])
    position = stream.position.copy()
    position[k] += by
    factor, residual = rows(inputs, state, replace(stream, position=position))
    relative = isinstance(factor, RelativePosesFactor)
    seconds = factor.seconds[factor.intervals.last] if relative else factor.instants
    (row,) = np.flatnonzero(np.abs(seconds - stream.seconds[k]) < 1e-9)
    if isinstance(factor, RelativePosesFactor):
        by = stream.rotation[factor.intervals.first[row]].T @ by
    np.testing.assert_allclose(residual[row, 3:], -by, atol=1e-7)


def test_a_rotation_that_is_turned_lowers_its_residual(world):
    inputs, state, stream = world
    k, by = last_of_a_row(*world), np.array([0.01, -0.02, 0.015])
    rotation = stream.rotation.copy()
    rotation[k] = rotation[k] @ Rotation.from_rotvec(by).as_matrix()
    factor, residual = rows(inputs, state, replace(stream, rotation=rotation))
    relative = isinstance(factor, RelativePosesFactor)
    seconds = factor.seconds[factor.intervals.last] if relative else factor.instants
    (row,) = np.flatnonzero(np.abs(seconds - stream.seconds[k]) < 1e-9)
    np.testing.assert_allclose(residual[row, :3], -by, atol=1e-7)


def test_poses_while_the_imu_did_not_run_are_left_out(world):
    inputs, state, stream = world
    stamps = np.concatenate([stream.stamps_ns, stream.stamps_ns[-1] + np.arange(6, 65) * 10_000_000])
    longer = PoseStream("mocap0", stamps, *(np.concatenate([x, x[:59]]) for x in (stream.rotation, stream.position)))
    factor, residual = rows(inputs, state, longer)
    assert np.abs(residual).max() < 1e-7
    assert factor.instants.max() <= stream.seconds[-1] + 0.06


@pytest.mark.parametrize("world", ["absolute"], indirect=True)
def test_each_recording_has_a_frame_of_its_own(world):
    """With the second half in another frame, the first frame's block has no say in it."""
    inputs, state, stream = world
    part = replace(inputs.parts[0])
    two = inputs_for(inputs.rig, [part.measurements, part.measurements])
    assert two.layout.block(frame_of("mocap0", 1), FRAME[0]).start is not None
    half = len(state.seconds) // 2
    moved = pose([0.0, 0.0, 0.7], [1.0, 2.0, 3.0])
    R, p = state.values[frame_of("mocap0", 0), FRAME[0]], state.values[frame_of("mocap0", 0), FRAME[1]]
    second = {(frame_of("mocap0", 1), FRAME[0]): moved[:3, :3] @ R}
    second |= {(frame_of("mocap0", 1), FRAME[1]): moved[:3, :3] @ p + moved[:3, 3]}
    rotation, position = state.rotation.copy(), state.position.copy()
    rotation[half:], position[half:] = moved[:3, :3] @ rotation[half:], position[half:] @ moved[:3, :3].T + moved[:3, 3]
    velocity = state.velocity.copy()
    velocity[half:] = velocity[half:] @ moved[:3, :3].T
    at = replace(
        state, rotation=rotation, position=position, velocity=velocity, values=state.values | second, starts=(0, half)
    )
    _, residual = rows(two, at, stream)
    assert np.abs(residual).max() < 1e-7


def test_residuals_are_those_of_matrices():
    """Against 4 x 4 matrices multiplied out."""
    rng = np.random.default_rng(0)
    T0, T1, T_wf, Z = (pose(rng.normal(size=3), rng.normal(size=3)) for _ in range(4))
    R, p = (T0[None, :3, :3], T1[None, :3, :3]), (T0[None, :3, 3], T1[None, :3, 3])
    measured = Z[None, :3, :3], Z[None, :3, 3]
    absolute = absolute_residuals(R[0], p[0], Frame(T_wf[:3, :3], T_wf[:3, 3]), *measured)
    for found, base, end in ((absolute, T_wf, T0), (relative_residuals(R, p, *measured), T0, T1)):
        expected = np.linalg.inv(base) @ end
        turn = Rotation.from_matrix(Z[:3, :3].T @ expected[:3, :3]).as_rotvec()
        np.testing.assert_allclose(found.residual[0], [*turn, *(expected[:3, 3] - Z[:3, 3])], atol=1e-12)


def test_noise_that_is_given_stays():
    noise = PoseNoise(0.01, 0.02)
    ratios = {"rotation": 4.0, "position": 9.0}
    assert estimated_noise(PoseSensor("a", "a"), noise, ratios) == PoseNoise(0.02, 0.06)
    assert estimated_noise(PoseSensor("a", "a"), noise, {"rotation": 4.0}) == PoseNoise(0.02, 0.02)
    assert estimated_noise(PoseSensor("a", "a", rotation_noise=0.01), noise, ratios) == PoseNoise(0.01, 0.06)
    assert estimated_noise(PoseSensor("a", "a", position_noise=0.02), noise, ratios) == PoseNoise(0.02, 0.02)
