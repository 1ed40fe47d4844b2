"""What the estimate is made from, and the state that its first pass starts from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.estimate.estimate import first_pass
from icalib.estimate.problem.assembly import host_times, nodes_for, resample, start_values
from icalib.estimate.problem.inputs import Inputs, inputs_for, with_clouds
from icalib.geometry.targets import NoTarget
from icalib.geometry.targets.base import BOARD
from icalib.initialize.assumed_motion import start_without_imu
from icalib.initialize.robot import wheel_values, with_robot
from icalib.initialize.steps.by_recording import each_clock
from icalib.initialize.steps.clocks import OneAxisError
from icalib.motion.nodes import first_nodes
from icalib.optim.state import Key, State, in_recording
from icalib.rig import Rig
from icalib.sensors.camera.bodies import without_bodies
from icalib.sensors.camera.initialize.boards.numbering import number_alike
from icalib.sensors.camera.initialize.boards.on_motion import with_mounts_guessed
from icalib.sensors.camera.initialize.boards.scene_growth import UntiedBodiesError
from icalib.sensors.camera.initialize.recordings import initial_guesses
from icalib.sensors.camera.initialize.tracks.on_motion import track_camera_values
from icalib.sensors.camera.initialize.with_imu import Guess, initial_trajectory
from icalib.sensors.lidar.initialize.rounds import state_from_lidar
from icalib.sensors.lidar.initialize.self_returns import without_own_robot
from icalib.sensors.pose.initialize.extrinsics import pose_values, state_from_poses


def start(
    rig: Rig, recordings: Sequence[Measurements], lap: Callable[[str], None] = lambda stage: None
) -> tuple[Inputs, State, dict[Key, np.ndarray]]:
    """What the estimate is made from, where it starts, and the guess at which stays what the data do not determine.

    A target gives the motion, or else a LiDAR, or if its scans do not show it points of the scene, or where there is
    neither camera nor LiDAR a pose sensor; what has no part in it is placed on that motion. Bodies of the target that
    images do not tie to the others are left out. Raises EstimationError where the recordings do not carry it.
    """
    recordings = number_alike(rig, recordings)
    while True:
        try:
            return _start(rig, recordings, lap)
        except UntiedBodiesError as untied:
            recordings = [without_bodies(rig.target, untied.names, m) for m in recordings]


def _start(
    rig: Rig, recordings: Sequence[Measurements], lap: Callable[[str], None]
) -> tuple[Inputs, State, dict[Key, np.ndarray]]:
    if rig.imu is None and (rig.wheels or rig.poses):
        found = start_without_imu(rig, recordings)
        lap("first guess")
        return found
    recordings = [without_own_robot(m) for m in recordings]
    whole = inputs_for(rig, recordings)
    if rig.lidars and not rig.has_target:
        alone = _lidars_alone(whole, recordings)
        try:
            state = state_from_lidar(alone)
        except EstimationError:
            if not rig.cameras:
                raise
        else:
            lap("first guess")
            return _with_all_but_lidars(whole, alone, state, lap)
    if not rig.cameras and not rig.lidars:
        return _start_from_poses(whole, recordings, lap)
    bare = whole
    if rig.wheels or rig.lidars or rig.poses:
        seeing = rig.with_(wheels=(), lidars=(), poses=())
        bare = inputs_for(seeing, [m.only(*seeing.sensors) for m in recordings], whole)
    guesses = _guesses(whole, recordings, bare)
    lap("first guess")
    state = first_state(bare, *guesses)
    lap("first state")
    if bare is whole:
        return whole, state, state.values
    inputs, settled, guess = with_robot(whole, first_pass(bare, state))
    lap("other sensors")
    return inputs, settled, guess | state.values


def _guesses(whole: Inputs, recordings: Sequence[Measurements], bare: Inputs) -> tuple[Guess, ...]:
    """Of the motion, by the cameras of `bare`; how these stand, a LiDAR's motion or a pose sensor's shows where their
    own does not."""
    rig, seen = whole.rig, [m.measurements for m in bare.motions]
    try:
        return initial_guesses(rig, bare.bodies, seen)
    except OneAxisError as error:
        if not rig.has_target or not (rig.lidars or rig.poses):
            raise
        alone = (_lidars_alone if rig.lidars else _pose_sensor_alone)(whole, recordings)
        try:
            state = state_from_lidar(alone) if rig.lidars else state_from_poses(alone)
            rig = with_mounts_guessed(rig, bare, alone, state)
        except EstimationError:
            raise error from None
        return initial_guesses(rig, bare.bodies, seen)


def _lidars_alone(whole: Inputs, recordings: Sequence[Measurements]) -> Inputs:
    rig = whole.rig.with_(cameras=(), wheels=(), poses=(), target=NoTarget())
    return inputs_for(rig, [m.only(*rig.sensors) for m in recordings], whole)


def _pose_sensor_alone(whole: Inputs, recordings: Sequence[Measurements]) -> Inputs:
    rig = whole.rig.with_(cameras=(), lidars=(), wheels=(), poses=whole.rig.poses[:1], target=NoTarget())
    return inputs_for(rig, [m.only(*rig.sensors) for m in recordings], whole)


def _with_all_but_lidars(
    whole: Inputs, alone: Inputs, state: State, lap: Callable[[str], None]
) -> tuple[Inputs, State, dict[Key, np.ndarray]]:
    """All of `start`, where the first LiDAR has shown the motion: the others are placed on it."""
    alone, state, guess = with_robot(alone, state)
    measured = replace(whole.measurements.with_streams(*alone.measurements.lidars), notes=alone.measurements.notes)
    inputs = replace(with_clouds(replace(whole, measurements=measured), alone.clouds), guess=alone.guess)
    cameras = track_camera_values(inputs, state)
    values = start_values(inputs, state.values | cameras)
    state = resample(replace(state, values=values), nodes_for(inputs, host_times(inputs, values)), inputs)
    others = wheel_values(inputs, state) | pose_values(inputs, state)
    lap("other sensors")
    return inputs, replace(state, values=state.values | others), guess | cameras | others


def _start_from_poses(
    whole: Inputs, recordings: Sequence[Measurements], lap: Callable[[str], None]
) -> tuple[Inputs, State, dict[Key, np.ndarray]]:
    """The first pose sensor gives the motion; others are placed on it, and so are wheels."""
    alone = _pose_sensor_alone(whole, recordings)
    state = state_from_poses(alone)
    lap("first guess")
    state = first_pass(alone, replace(state, values=state.values | pose_values(alone, state)))
    guess = state.values | wheel_values(whole, state) | pose_values(whole, state)
    lap("other sensors")
    return whole, replace(state, values=guess), guess


def first_state(inputs: Inputs, *guesses: Guess) -> State:
    """The state that the first pass starts from: the guess of each of `inputs.motions` at all its nodes."""
    values = guesses[0].values()
    for k, guess in enumerate(guesses):
        values[in_recording(BOARD, k), "tilt"] = guess.R_world_board
    for camera in inputs.rig.cameras if len(guesses) > 1 else ():
        if camera.clock_restarts:
            own = [g.cameras[camera.name].offset for g in guesses]
            values[camera.name, "time_offset"] = each_clock(inputs, camera.name, own.__getitem__)
    values = start_values(inputs, values)
    nodes = nodes_for(inputs, host_times(inputs, values))
    starts = first_nodes(inputs.imu, nodes)
    own = [(g, m, t - m.begin) for g, m, t in zip(guesses, inputs.motions, np.split(nodes, starts[1:]), strict=True)]
    paths = [initial_trajectory(guess, inputs.rig, motion.measurements, t) for guess, motion, t in own]
    rotation, position, velocity = (np.concatenate(x) for x in zip(*paths, strict=True))
    bias = np.concatenate([guess.biases(len(t)) for guess, _, t in own])
    return State(nodes, rotation, position, velocity, bias, values, starts)
