"""The initial guess: inputs of the estimate, and the state at which its first pass starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from icalib.data.measurements import Measurements, PoseStream
from icalib.errors import EstimationError
from icalib.estimate.problem.assembly import keyframe_times, keyframes_for, resample, start_values
from icalib.estimate.problem.inputs import Inputs, inputs_for
from icalib.initialize.assumed_motion import guess_with_assumed_motion
from icalib.initialize.assumed_sensors import ASSUMED_POSES, pose_sensor_for
from icalib.initialize.recording_times import naming_recording_times
from icalib.initialize.steps.initializer import (
    InitialGuess,
    Initializer,
    UnusableMeasurementsError,
    Values,
    inputs_of_sensors,
    keyframe_hosts,
    kinds_of,
    motion_kinds,
    place_sensors,
)
from icalib.optim.state import State
from icalib.rig import Rig


def guess_of_rig(
    rig: Rig, recordings: Sequence[Measurements], lap: Callable[[str], None] = lambda stage: None
) -> InitialGuess:
    """Inputs of the estimate, its start state, and the guess to which unobservable parameters are reset.

    The trajectory comes from the first kind in `motion_kinds` that shows it. All other sensors are aligned to it.
    Measurements that cannot be used are left out, such as those of bodies that no image connects to the rest of the
    target. lap: called at the end of each stage with its name. Raises EstimationError if the recordings do not
    determine a guess.
    """
    for kind in kinds_of(rig):
        recordings = kind.unambiguous(rig, recordings)
    with naming_recording_times(recordings):
        while True:
            try:
                return _guess(rig, recordings, lap)
            except UnusableMeasurementsError as error:
                recordings = [error.usable(rig, m) for m in recordings]


def _guess(rig: Rig, recordings: Sequence[Measurements], lap: Callable[[str], None]) -> InitialGuess:
    """As `guess_of_rig`. Raises UnusableMeasurementsError if measurements must be left out."""
    if rig.imu is None and not rig.cameras_alone:
        guess = guess_with_assumed_motion(rig, recordings)
        lap("first guess")
        return guess
    for kind in kinds_of(rig):
        recordings = [kind.cleaned(m) for m in recordings]
    inputs = inputs_for(rig, recordings)
    source, source_inputs, state = _trajectory(inputs, recordings, motion_kinds(rig))
    lap("first guess")
    if source_inputs is inputs and not source.refined_alone:
        return inputs, state, state.values
    guess = _align_to_trajectory(inputs, source, *source.refined(source_inputs, state))
    lap("other sensors")
    return guess


def _trajectory(
    inputs: Inputs, recordings: Sequence[Measurements], kinds: Sequence[Initializer[Any]]
) -> tuple[Initializer[Any], Inputs, State]:
    """The first of `kinds` whose sensors show the motion, their inputs, and a state with the trajectory. There is no
    fallback for cameras that see a target: their error is raised. Raises EstimationError if no kind shows the motion.
    """
    if not kinds:
        raise EstimationError("no sensor of the rig shows its motion; add a camera, a LiDAR or a pose sensor.")
    kind, *fallbacks = kinds
    source_inputs = inputs_of_sensors(inputs, recordings, kind.sources(inputs.rig))

    def fallback() -> tuple[Inputs, State]:
        return _trajectory(inputs, recordings, fallbacks)[1:]

    try:
        return kind, source_inputs, kind.trajectory(source_inputs, fallback)
    except EstimationError as error:
        can_do_without = inputs.rig.wheels and not any(s.needs_imu for s in inputs.rig.mounted)
        if source_inputs.rig.has_target or not (fallbacks or can_do_without):
            raise
        if not fallbacks:
            return _on_assumed_motion(inputs, recordings, error)
    return _trajectory(inputs, recordings, fallbacks)


def _on_assumed_motion(
    inputs: Inputs, recordings: Sequence[Measurements], failed: EstimationError
) -> tuple[Initializer[Any], Inputs, State]:
    """As `_trajectory`, from the motion that the other sensors show without the IMU, such as wheels and fixes. A pose
    sensor stands for it. Raises `failed` if they do not show it either."""
    imu = inputs.rig.imu
    assert imu is not None
    others = [m.without(imu.name) for m in recordings]
    try:
        assumed, state, _ = guess_with_assumed_motion(inputs.rig.without(imu.name), others)
        posed, rig = [], inputs.rig.only(imu.name).with_sensors(pose_sensor_for(ASSUMED_POSES))
        for m, without, k, part in zip(recordings, others, state.recordings, assumed.parts, strict=True):
            stamps = without.origin_ns + np.round(1e9 * (state.seconds[k] - part.begin)).astype(np.int64)
            poses = PoseStream(ASSUMED_POSES, stamps, state.rotation[k], state.position[k])
            posed.append(m.only(imu.name).with_streams(poses))
        source_inputs, source = inputs_for(rig, posed, inputs), motion_kinds(rig)[0]
        return source, source_inputs, source.trajectory(source_inputs, lambda: (source_inputs, state))
    except EstimationError:
        raise failed from None


def _align_to_trajectory(
    inputs: Inputs, source: Initializer[Any], source_inputs: Inputs, state: State, guess: Values
) -> InitialGuess:
    """The initial guess for all sensors of `inputs`, from the trajectory in `state` by the sensors of `source_inputs`.
    All other sensors are aligned to it. guess: of the parameters in `state`."""
    rig, inputs = inputs.rig, source.adopted(inputs, source_inputs)
    unplaced = [s for s in rig.mounted if s.name not in source_inputs.rig.sensors]
    hosts = keyframe_hosts(unplaced)
    placed = place_sensors(inputs, state, hosts)
    if hosts or source.moves_keyframes:
        values = start_values(inputs, state.values | placed)
        state = resample(replace(state, values=values), keyframes_for(inputs, keyframe_times(inputs, values)), inputs)
    placed |= place_sensors(inputs, state, [s for s in unplaced if s not in hosts])
    state, guess = replace(state, values=state.values | placed), guess | placed
    for kind in kinds_of(rig):
        if kind is not source:
            inputs, state, changed = kind.associated(inputs, state)
            guess = guess | changed
    return inputs, state, guess
