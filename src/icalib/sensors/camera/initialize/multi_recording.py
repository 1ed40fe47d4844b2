"""Start state of the estimator from the initial guesses of cameras.

Initial guesses for several recordings: one of them determines the calibration, which is fixed for the others.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import CalibrationError, EstimationError
from icalib.estimate.problem.assembly import keyframe_times, keyframes_for, start_values
from icalib.estimate.problem.inputs import Inputs
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets.base import BOARD
from icalib.initialize.steps.rate_alignment import OneAxisError, contradicting_offset
from icalib.initialize.steps.single_recording import offset_of_each_clock
from icalib.model.bodies import Bodies
from icalib.motion.imu_data import imu_data
from icalib.motion.keyframe_placement import first_keyframes
from icalib.optim.state import State, in_recording
from icalib.rig import Camera, Rig
from icalib.sensors.camera.initialize.boards.scene_intrinsics import check_bodies_still, find_scene
from icalib.sensors.camera.initialize.boards.target_poses import camera_rates
from icalib.sensors.camera.initialize.boards.target_scene import TargetScene, scene_poses
from icalib.sensors.camera.initialize.guess import CameraGuess, Guess
from icalib.sensors.camera.initialize.target_with_imu import initial_guess, initial_trajectory
from icalib.sensors.camera.initialize.tracks.from_tracks import guess_from_tracks
from icalib.sensors.parameter import fixed


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


def initial_guesses(rig: Rig, bodies: Bodies, recordings: Sequence[Measurements]) -> tuple[Guess, ...]:
    """The initial guess of each recording, all with the same calibration and the same scene of bodies.

    The calibration comes from the recording with most images that gives a guess. Raises EstimationError if a recording
    gives no guess, if its time offsets differ from the others', or if bodies were moved. With several recordings and a
    target, the message names the recording.
    """
    if not rig.has_target:
        return _guesses_from_tracks(rig, recordings)
    scene = find_scene(rig, bodies, recordings)
    if len(recordings) == 1:
        return (initial_guess(rig, recordings[0], scene),)
    check_bodies_still(rig, scene, recordings)
    order = sorted(range(len(recordings)), key=lambda k: -sum(len(c.stamps_ns) for c in recordings[k].cameras))
    best, guess = _first_successful(rig, scene, [(k, recordings[k]) for k in order])
    fixed_rig = _with_fixed_calibration(rig, guess, recordings[best])
    guesses = []
    for k, recording in enumerate(recordings):
        if k == best:
            guesses.append(guess)
            continue
        _check_clocks(rig, scene, guess, recordings[best], recording)
        guesses.append(_guess_of(fixed_rig, scene, recording))
    return tuple(guesses)


def _guesses_from_tracks(rig: Rig, recordings: Sequence[Measurements]) -> tuple[Guess, ...]:
    """Guesses from feature tracks. The recording with most observations gives the calibration of all."""
    best = max(recordings, key=lambda r: sum(len(t.uv) for t in r.tracks))
    guess = guess_from_tracks(rig, best)
    fixed_rig = _with_fixed_calibration(rig, guess, best)
    return tuple(guess if r is best else guess_from_tracks(fixed_rig, r) for r in recordings)


def _first_successful(rig: Rig, scene: TargetScene, recordings: list[tuple[int, Measurements]]) -> tuple[int, Guess]:
    """Number and guess of the first of `recordings` that gives a guess.

    recordings: pairs of number and recording. Raises the EstimationError of the first recording if none gives a guess.
    """
    failed: list[EstimationError] = []
    for k, recording in recordings:
        try:
            return k, _guess_of(rig, scene, recording)
        except EstimationError as error:
            failed.append(error)
    raise failed[0]


def _guess_of(rig: Rig, scene: TargetScene, recording: Measurements) -> Guess:
    """The guess of one recording. Raises EstimationError with a message that names the recording."""
    try:
        return initial_guess(rig, recording, scene)
    except CalibrationError as error:
        named = OneAxisError if isinstance(error, OneAxisError) else EstimationError
        raise named(f"{recording.name}: {error}") from error


def _with_fixed_calibration(rig: Rig, guess: Guess, recording: Measurements) -> Rig:
    """The rig with all camera parameters fixed at `guess`, the guess of `recording`.

    Time offsets of clocks that restart are not changed.
    """

    def camera(c: Camera, estimate: CameraGuess, origin_ns: int) -> Camera:
        offset = estimate.offset - (origin_ns - recording.origin_ns) * 1e-9
        return dataclasses.replace(
            c,
            rotation=fixed(estimate.rotation),
            translation=fixed(estimate.position),
            time_offset=c.time_offset if c.clock_restarts else fixed(np.array([offset])),
            intrinsics=fixed(estimate.params[:4]),
            distortion=fixed(estimate.params[4:]),
        )

    pairs = zip(rig.cameras, recording.cameras, strict=True)
    return rig.with_sensors(*(camera(c, guess.cameras[c.name], s.origin_ns) for c, s in pairs))


def _check_clocks(rig: Rig, scene: TargetScene, guess: Guess, reference: Measurements, recording: Measurements) -> None:
    """Raises EstimationError if a camera's time offset in `recording` differs from that in `reference`.

    guess: the guess of `reference`. Clocks that restart are not checked, nor rigs without an IMU.
    """
    imu = imu_data(rig, recording)
    if imu is None:
        return
    for camera, stream, before in zip(rig.cameras, recording.cameras, reference.cameras, strict=True):
        if camera.clock_restarts:
            continue
        estimate = guess.cameras[camera.name]
        origins_ns = (stream.origin_ns - recording.origin_ns) - (before.origin_ns - reference.origin_ns)
        expected = estimate.offset + origins_ns * 1e-9
        poses = scene_poses(stream, camera_model(camera.model), estimate.params, scene)
        try:
            rates = camera_rates(stream, poses)
        except EstimationError as error:
            raise EstimationError(f"{recording.name}: {error}") from error
        offset = contradicting_offset(imu, camera.name, rates, expected)
        if offset is not None:
            raise EstimationError(
                f"{recording.name}: the time offset of {camera.name} differs by {offset - expected:+.3f} s from "
                f"that in {reference.name}. If a clock was set or restarted in between, write clock_restarts: "
                "true for the sensor in the rig file; else calibrate this recording alone."
            )
