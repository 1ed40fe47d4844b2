"""Start state of the estimator from the initial guesses of cameras."""

from __future__ import annotations

import numpy as np

from icalib.estimate.problem.assembly import keyframe_times, keyframes_for, start_values
from icalib.estimate.problem.inputs import Inputs
from icalib.geometry.targets.base import BOARD
from icalib.initialize.steps.single_recording import offset_of_each_clock
from icalib.motion.keyframe_placement import first_keyframes
from icalib.optim.state import State, in_recording
from icalib.sensors.camera.initialize.guess import Guess
from icalib.sensors.camera.initialize.target_with_imu import initial_trajectory


def initial_state(inputs: Inputs, *guesses: Guess) -> State:
    """Keyframe states and calibration parameters, from one guess for each recording in `inputs.motions`.

    All guesses have the same calibration, except the time offsets of cameras whose clock restarts.
    """
    values = guesses[0].values()
    for k, guess in enumerate(guesses):
        values[in_recording(BOARD, k), "tilt"] = guess.R_world_board
    for camera in inputs.rig.cameras if len(guesses) > 1 else ():
        if camera.clock_restarts:
            offsets = [g.cameras[camera.name].offset for g in guesses]
            values[camera.name, "time_offset"] = offset_of_each_clock(inputs, camera.name, offsets.__getitem__)
    values = start_values(inputs, values)
    keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
    starts = first_keyframes(inputs.imu, keyframes)
    parts = [
        (g, m, t - m.begin) for g, m, t in zip(guesses, inputs.motions, np.split(keyframes, starts[1:]), strict=True)
    ]
    trajectories = [initial_trajectory(guess, inputs.rig, motion.measurements, t) for guess, motion, t in parts]
    rotation, position, velocity = (np.concatenate(x) for x in zip(*trajectories, strict=True))
    bias = np.concatenate([guess.biases(len(t)) for guess, _, t in parts])
    return State(keyframes, rotation, position, velocity, bias, values, starts)
