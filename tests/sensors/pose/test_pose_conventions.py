"""Poses written another way than they should be are named, whether they give the motion or are placed on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each

from icalib.data.measurements import PoseStream
from icalib.errors import EstimationError
from icalib.estimate.inputs import inputs_for
from icalib.optim.state import State
from icalib.sensors.pose.initialize import pose_values, state_from_poses
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.simulation import Drive, Room, Scenario, rig_for, simulate

pytestmark = pytest.mark.slow


def inverted(x: PoseStream) -> PoseStream:
    T = np.tile(np.eye(4), (len(x.stamps_ns), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = x.rotation, x.position
    T = np.linalg.inv(T)
    return replace(x, rotation=T[:, :3, :3].copy(), position=T[:, :3, 3].copy())


def conjugated(x: PoseStream) -> PoseStream:
    q = Rotation.from_matrix(x.rotation).as_quat() * [-1.0, -1.0, -1.0, 1.0]
    return replace(x, rotation=Rotation.from_quat(q).as_matrix())


def left_handed(x: PoseStream) -> PoseStream:
    """x and y swapped, of the frame and of the sensor."""
    swap = np.eye(3)[[1, 0, 2]]
    return replace(x, rotation=swap @ x.rotation @ swap, position=x.position @ swap)


def upside_down(x: PoseStream) -> PoseStream:
    return replace(x, position=x.position * [1.0, 1.0, -1.0])


def w_first(x: PoseStream) -> PoseStream:
    """w, x, y, z read as x, y, z, w."""
    q = Rotation.from_matrix(x.rotation).as_quat()
    return replace(x, rotation=Rotation.from_quat(q[:, [3, 0, 1, 2]]).as_matrix())


def y_up(x: PoseStream) -> PoseStream:
    """Rotations are those of a frame with y up, positions have z up."""
    up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return replace(x, rotation=up @ x.rotation)


def cyclic(x: PoseStream) -> PoseStream:
    return replace(x, position=x.position[:, [1, 2, 0]])


def askew(x: PoseStream) -> PoseStream:
    return replace(x, position=x.position @ Rotation.from_euler("z", 50.0, degrees=True).as_matrix().T)


WRONG = [
    (inverted, "the poses of mocap0 are inverted"),
    (conjugated, "the poses of mocap0 have inverted rotations"),
    (left_handed, "the poses of mocap0 are in left-handed axes"),
    (upside_down, "the poses of mocap0 have the z axis of the position reversed; set its position_axes to .x, y, -z."),
    (w_first, "the poses of mocap0 have quaternions with w first"),
    (y_up, "of mocap0 have positions and rotations in different frames.*set its position_axes to .x, z, -y."),
    (cyclic, "of mocap0 have positions and rotations in different frames.*set its position_axes to .z, x, y."),
    (askew, r"rotations in different frames.*roll, pitch, yaw of -?\d, -?\d, -5\d deg would fit"),
]


@pytest.fixture(scope="module", params=[1, pytest.param(2, marks=pytest.mark.full)])
def sim(request):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([2.0, -0.5, 1.0]).as_matrix(), [0.1, -0.2, 0.15]
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = Rotation.from_rotvec([0.0, 0.0, 2.0]).as_matrix(), [3.0, -1.0, 0.5]
    mocap = SimPoses("mocap0", T, T_world_frame=frame, time_offset_s=0.5, rate_hz=50.0, clock_origin_ns=777)
    scenario = Scenario((), duration_s=12.0, motion=Drive("free"), board=False, room=Room(), sensors=(mocap,))
    return simulate(scenario, request.param)


def state_of(sim) -> State:
    keyframes = np.arange(0.05, 11.5, 0.05)
    bias = np.concatenate([sim.truth.gyro_bias.mean(axis=0), sim.truth.accel_bias.mean(axis=0)])
    R, p, v = sim.truth.pose_at(keyframes + sim.truth.seconds[0])
    return State(keyframes, R, p, v, np.tile(bias, (len(keyframes), 1)), {("imu0", "intrinsics"): np.zeros(24)})


def inputs_of(sim, way):
    written = sim.measurements.with_streams(*(way(x) for x in sim.measurements.poses))
    return inputs_for(rig_for(sim.scenario), [written])


@each(("way", "words"), WRONG)
def test_written_another_way(sim, way, words):
    with pytest.raises(EstimationError, match=words):
        state_from_poses(inputs_of(sim, way))


@each(("way", "words"), WRONG[:1] + WRONG[-1:], full=WRONG[1:-1])
def test_written_another_way_than_a_known_motion(sim, way, words):
    """The same conventions are tried, by another fit: one of both fields, one of the positions alone."""
    inputs = inputs_of(sim, way)
    with pytest.raises(EstimationError, match=words):
        pose_values(inputs, state_of(sim), inputs.rig.poses)


def test_on_a_floor_inverted_poses_fit_by_their_rates_alone():
    """The inverse turns the other way about the one axis, as if the sensor stood upside down."""
    scenario = Scenario(
        (),
        duration_s=8.0,
        motion=Drive("planar"),
        board=False,
        room=Room(),
        sensors=(SimPoses("mocap0", np.eye(4), rate_hz=50.0),),
    )
    sim = simulate(scenario, 1)
    inputs = inputs_for(rig_for(scenario), [sim.measurements.with_streams(inverted(sim.measurements.poses[0]))])
    with pytest.raises(EstimationError, match="the poses of mocap0 are inverted"):
        state_from_poses(inputs)
    state_from_poses(inputs_for(rig_for(scenario), [sim.measurements]))


def test_a_motion_of_another_recording_is_not_called_inverted(sim):
    other = simulate(sim.scenario, 7).measurements.poses
    inputs = inputs_for(rig_for(sim.scenario), [sim.measurements.with_streams(*other)])
    with pytest.raises(EstimationError, match="does not match"):
        state_from_poses(inputs)
