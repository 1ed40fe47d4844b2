"""Initial guess of cameras: intrinsics, distortion, extrinsics, time offsets, and the trajectory from their images.

The guess comes from images of a target (`target_with_imu`) or from feature tracks (`from_tracks`). Tracks without
parallax leave the translation of cameras unobservable.

Extrinsics of cameras by hand-eye calibration with the trajectory of a LiDAR or a pose sensor.

A robot on a floor rotates about one axis only. The rotation of a camera about that axis is then unobservable from
angular rates. The translations of both trajectories make it observable.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import CalibrationError, EstimationError
from icalib.estimate.estimate import first_pass
from icalib.estimate.inputs import Inputs, inputs_for
from icalib.estimate.problem import keyframe_times, keyframes_for, motion_of, start_values
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets.base import BOARD
from icalib.initialize.assumed_motion import SLOW_HZ
from icalib.initialize.initializer import (
    BY_TARGET,
    BY_TRACKS,
    BodyTrajectory,
    FailedEstimate,
    InitialGuess,
    Initializer,
    InputsWithMotion,
    KnownExtrinsics,
    MotionSource,
    Values,
    converted_offset,
    fullest_recording,
    known_value,
    naming_recording,
    offset_of_each_clock,
    single_recording,
    state_of_recording,
    stated_values,
)
from icalib.initialize.rate_alignment import OneAxisError, contradicting_offset, main_axis, rough_alignments
from icalib.initialize.smooth_trajectory import BodyPoses
from icalib.initialize.trajectories import SensorTrajectory, extrinsics_on_trajectory
from icalib.model.bodies import Bodies
from icalib.motion.imu_data import imu_data
from icalib.motion.poses import first_keyframes
from icalib.optim.arrowhead import N_THREADS
from icalib.optim.state import Key, State, in_recording
from icalib.rig import Camera, Parameter, Rig
from icalib.sensors.camera.initialize.epipolar import (
    CameraExtrinsics,
    ImagePairs,
    extrinsics_on_motion,
    refine_relative_pose,
    rotation_error,
    rotation_without_translation,
)
from icalib.sensors.camera.initialize.from_tracks import guess_from_tracks, start_intrinsics
from icalib.sensors.camera.initialize.guess import CameraGuess, Guess, relative_offset, resolve_symmetry
from icalib.sensors.camera.initialize.joint_alignment import SharedRays, matching_track_rates, shared_rays
from icalib.sensors.camera.initialize.scene_intrinsics import check_bodies_still, find_scene, intrinsics_of
from icalib.sensors.camera.initialize.target_poses import camera_rates
from icalib.sensors.camera.initialize.target_scene import TargetScene, scene_poses
from icalib.sensors.camera.initialize.target_with_imu import initial_guess, initial_trajectory
from icalib.sensors.parameter import fixed
from icalib.sensors.sensor import MOUNTED_NAMES, mounted
from icalib.sensors.stream import seconds_since


class CameraInitializer(Initializer[Camera]):
    """Initial guess of all cameras of a rig.

    Cameras that see a target are the preferred source of the trajectory. Cameras with feature tracks come after LiDARs;
    if another sensor gives the trajectory, they are aligned to it.
    """

    hosts_keyframes = True
    refined_alone = False  # a refinement would repeat the first pass of the estimator

    def motion_source(self, rig: Rig) -> MotionSource | None:
        """See `Initializer`: `BY_TARGET` with a target, `BY_TRACKS` with an IMU but no target, else None."""
        if not rig.cameras or (rig.imu is None and not rig.has_target):
            return None
        return MotionSource(BY_TARGET if rig.has_target else BY_TRACKS, tuple(c.name for c in rig.cameras))

    def prepared(self, rig: Rig, recordings: Sequence[Measurements]) -> Sequence[Measurements]:
        """See `Initializer`: the points of symmetric targets are numbered consistently."""
        return resolve_symmetry(rig, recordings)

    def trajectory(self, inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> State:
        """See `Initializer`: the trajectory interpolated between camera poses, and the guess of all cameras."""
        return initial_state(inputs, *_guesses_by_recording(inputs, fallback))

    def refined(self, inputs: Inputs, source_inputs: Inputs, state: State) -> InitialGuess:
        """See `Initializer`: refines the trajectory by the first pass of the estimator."""
        return inputs, first_pass(source_inputs, state), state.values

    def place(self, inputs: Inputs, state: State, sensors: Sequence[Camera]) -> Values:
        """Values of cameras with feature tracks, aligned to the trajectory in `state`."""
        return track_camera_values(inputs, state)

    def body_poses(self, rig: Rig, recordings: Sequence[Measurements]) -> BodyTrajectory:
        """See `Initializer`: poses of the body from the images of all cameras, without an IMU."""
        _refuse_slow_shutters(rig, recordings)
        cameras_only = rig.only(*(c.name for c in rig.cameras))
        inputs = inputs_for(cameras_only, [m.only(*cameras_only.sensors) for m in recordings])
        (guess,) = initial_guesses(cameras_only, inputs.bodies, [m.measurements for m in inputs.motions])
        t, *of_poses = guess.body_poses(inputs.measurements)
        recording = np.searchsorted([part.begin for part in inputs.parts], t, side="right") - 1
        poses = []
        for k, (part, m) in enumerate(zip(inputs.parts, recordings, strict=True)):
            # the first images are not used where their tags are not seen together with the others
            unused = 1e-9 * (part.measurements.origin_ns - m.origin_ns)
            poses.append(BodyPoses(*(x[recording == k] for x in (t - part.begin + unused, *of_poses))))
        return BodyTrajectory(poses, guess.values())

    def explained(self, failed: FailedEstimate) -> EstimationError | None:
        """See `Initializer`: the error that feature tracks lack parallax, else None. None for rigs with a target."""
        if failed.converges is None or failed.rig.has_target:
            return None
        return no_parallax(failed.rig, failed.recordings)


def _refuse_slow_shutters(rig: Rig, recordings: Sequence[Measurements]) -> None:
    """Raises EstimationError if images with a rolling shutter do not resolve the motion, in a rig without an IMU."""
    for camera in (c for c in rig.cameras if c.rolling):
        for stream in (m.streams[camera.name] for m in recordings):
            rate = (len(stream.seconds) - 1) / max(float(stream.seconds[-1]), 1e-9) if len(stream.seconds) else 0.0
            if rate < SLOW_HZ:
                raise EstimationError(
                    f"{camera.name}: without an IMU a rolling shutter needs {SLOW_HZ:g} images in a second, and has "
                    f"{rate:.2g}; record faster, add an IMU, or hold still at each view and remove shutter."
                )


def _guesses_by_recording(inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> tuple[Guess, ...]:
    """The initial guess of each recording.

    A rig that rotated about one axis only leaves the camera's rotation about that axis unobservable from angular rates.
    That rotation then comes from hand-eye calibration with the trajectory that `fallback` returns, of the next kind of
    sensor. Raises OneAxisError if this fails, too; EstimationError if a recording gives no guess.
    """
    rig, recordings = inputs.rig, [m.measurements for m in inputs.motions]
    try:
        return initial_guesses(rig, inputs.bodies, recordings)
    except OneAxisError as error:
        if not rig.has_target:
            raise
        try:
            rig = with_hand_eye_guess(rig, inputs, *fallback())
        except EstimationError:
            raise error from None
        return initial_guesses(rig, inputs.bodies, recordings)


INITIALIZER = CameraInitializer()


def with_hand_eye_guess(rig: Rig, camera_inputs: Inputs, others: Inputs, state: State) -> Rig:
    """`rig` with an initial guess of the extrinsics and time offset of each camera without a stated rotation.

    For each camera, the recording with most of its corners is used. camera_inputs: inputs of the cameras; others:
    inputs of the sensors whose trajectory is in `state`. Raises EstimationError if the motion does not determine the
    extrinsics.
    """
    recordings = [m.measurements for m in camera_inputs.motions]
    scene = find_scene(rig, camera_inputs.bodies, recordings)

    def with_guess(number: int, camera: Camera) -> Camera:
        best = int(np.argmax([len(r.cameras[number].uv) for r in recordings]))
        stream, inputs = recordings[best].cameras[number], single_recording(others, best)
        poses = scene_poses(stream, camera_model(camera.model), intrinsics_of(camera, stream, rig.target, scene), scene)
        ok, stamps = poses.ok, stream.stamps_ns[poses.ok]
        seconds = seconds_since(stamps, int(stamps[0]))
        path = SensorTrajectory(seconds, poses.rotation[ok], poses.position[ok], np.ones(len(stamps), dtype=bool))
        assert inputs.imu is not None
        with naming_recording(others, best):
            extrinsics, _ = extrinsics_on_trajectory(
                inputs.imu, camera.name, path, state_of_recording(others, best, state), KnownExtrinsics()
            )
        offset = extrinsics.offset - 1e-9 * (int(stamps[0]) - recordings[best].origin_ns)
        guess = mounted(extrinsics.rotation, extrinsics.position, np.array([offset]))
        return replace(
            camera, **{k: Parameter("free", v) for k, v in guess.items() if getattr(camera, k).value is None}
        )

    return rig.with_sensors(*(with_guess(k, c) for k, c in enumerate(rig.cameras) if c.rotation.value is None))


# Parallax over the median epipolar error. Noise alone gives up to 2.3, because parallax contains the errors of both
# rays in two axes, and the epipolar error those in one axis. Twice the value would refuse motion with usable parallax.
MIN_PARALLAX_RATIO = 3.0


def no_parallax(rig: Rig, recordings: Sequence[Measurements]) -> EstimationError | None:
    """An EstimationError, not raised, if no camera in any recording has parallax beyond noise; else None.

    It names the camera with the largest ratio of parallax to noise. Also None if a recording has no IMU data, or the
    intrinsics of a camera are not found.
    """
    ratios: list[tuple[float, float, str]] = []
    for m in recordings:
        imu = imu_data(rig, m)
        for k, (camera, stream) in enumerate(zip(rig.cameras, m.tracks, strict=True)):
            if imu is None:
                return None
            try:
                lens = start_intrinsics(camera, stream, imu, m)
            except EstimationError:
                return None
            pairs = [_parallax(pair) for pair in shared_rays(k, stream, camera_model(camera.model), lens)]
            if pairs:
                parallax, error = np.median(pairs, axis=0).tolist()
                ratios.append((parallax, error, camera.name))
    if not ratios:
        return None
    parallax, error, name = max(ratios, key=lambda x: x[0] / x[1])
    if parallax > MIN_PARALLAX_RATIO * error:
        return None
    return EstimationError(
        f"{name}: the tracked points move as in a pure rotation (parallax {np.rad2deg(parallax):.2g} deg, "
        f"noise {np.rad2deg(error):.2g} deg), so its translation is unobservable. Move the rig by a "
        "tenth of the distance to the scene or more, and turn it about all axes."
    )


def _parallax(pair: SharedRays) -> tuple[float, float]:
    """Parallax and epipolar error of two images, medians over their shared points [rad].

    The parallax is the distance between corresponding unit rays after the best rotation. The epipolar error is the
    angle between a ray and its epipolar plane.
    """
    R, t = rotation_without_translation(pair.f, pair.h)
    parallax = float(np.median(np.linalg.norm(pair.f @ R.T - pair.h, axis=1)))
    refine_relative_pose(pair.f, pair.h, R, t)
    return parallax, rotation_error(pair.f, pair.h, R, t)[1] + 1e-12


# Start state of the estimator from the initial guesses of cameras.
#
# Initial guesses for several recordings: one of them determines the calibration, which is fixed for the others.


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


# Calibration parameters of cameras with feature tracks, on a trajectory from other sensors.


def track_camera_values(inputs: Inputs, state: State) -> dict[Key, np.ndarray]:
    """Calibration parameters of all cameras: values of the rig file, else estimates from their tracks.

    state: with the trajectory of the IMU. Raises EstimationError if neither determines a parameter.
    """

    def values_of(number: int) -> dict[Key, np.ndarray]:
        camera, best = inputs.rig.cameras[number], fullest_recording(inputs, inputs.measurements.tracks[number].key)
        with naming_recording(inputs, best):
            lens = _start_lens(inputs, number, best)
        known = stated_values(inputs, camera)
        values = {(camera.name, "intrinsics"): lens[:4], (camera.name, "distortion"): lens[4:]}
        if len(known) < len(MOUNTED_NAMES):
            values |= _estimated_values(inputs, state, number, lens)
        return values | known

    with ThreadPoolExecutor(N_THREADS) as pool:  # not the solver's pool: tasks may wait for its threads
        parts = pool.map(values_of, range(len(inputs.rig.cameras)))
        return {k: v for part in parts for k, v in part.items()}


def _start_lens(inputs: Inputs, number: int, recording: int) -> np.ndarray:
    """(P,) start values of the intrinsics and distortion of camera `number`, from the recording number `recording`."""
    single = single_recording(inputs, recording)
    assert single.imu is not None
    stream = single.measurements.tracks[number]
    return start_intrinsics(inputs.rig.cameras[number], stream, single.imu, single.measurements)


def _estimated_values(inputs: Inputs, state: State, number: int, lens: np.ndarray) -> dict[Key, np.ndarray]:
    """Extrinsics, time offset, intrinsics and distortion of camera `number`, with start values `lens` (P,).

    They come from the recording with most observations. A clock that restarts has one offset for each recording.
    """
    camera, best = inputs.rig.cameras[number], fullest_recording(inputs, inputs.measurements.tracks[number].key)
    estimate_in = partial(_estimate_in, inputs, state, number, lens)
    with naming_recording(inputs, best):
        extrinsics, lens = estimate_in(best)
    if camera.clock_restarts:
        offset = offset_of_each_clock(
            inputs, camera.name, lambda k: estimate_in(k, extrinsics)[0].offset, {best: extrinsics.offset}
        )
    else:
        offset = np.array([converted_offset(extrinsics.offset, camera.name, single_recording(inputs, best), inputs)])
    values = mounted(extrinsics.rotation, extrinsics.position, offset)
    values |= {"intrinsics": lens[:4], "distortion": lens[4:]}
    return {(camera.name, name): np.ascontiguousarray(value) for name, value in values.items()}


def _estimate_in(
    inputs: Inputs, state: State, number: int, lens: np.ndarray, recording: int, known: CameraExtrinsics | None = None
) -> tuple[CameraExtrinsics, np.ndarray]:
    """Extrinsics, and intrinsics with distortion (P,), of camera `number` from the recording number `recording`.

    known: rotation and translation to keep, or None; lens: (P,) start values."""
    single, camera = single_recording(inputs, recording), inputs.rig.cameras[number]
    assert single.imu is not None
    stream, model = single.measurements.tracks[number], camera_model(camera.model)
    fixed = {name: value for (_, name), value in stated_values(single, camera).items()}
    if known is not None:
        fixed |= {"rotation": known.rotation, "translation": known.position}
    offsets = [float(fixed["time_offset"][0])] if "time_offset" in fixed else None
    same_clock = relative_offset(np.zeros(1), single.measurements.cameras[number], single.measurements)
    pairs = ImagePairs.of(stream, model, lens, _free_directions(camera, lens))
    lens_step = np.zeros(len(pairs.lens_directions))
    rates = matching_track_rates(single.imu, stream, model, lens)
    starts = [
        CameraExtrinsics(fixed.get("rotation", a.rotation), fixed.get("translation", np.zeros(3)), a.offset, lens_step)
        for a in rough_alignments(single.imu, camera.name, rates, offsets, same_clock)
    ]
    motion = motion_of(single, state_of_recording(inputs, recording, state))
    is_fixed = np.repeat([name in fixed for name in MOUNTED_NAMES], [3, 3, 1])
    axis = None if "rotation" in fixed else main_axis(single.imu.gyro)
    extrinsics = extrinsics_on_motion(pairs, motion, starts, axis, is_fixed)
    return extrinsics, pairs.lens_of(extrinsics)


def _free_directions(camera: Camera, lens: np.ndarray) -> np.ndarray:
    """(L, P) directions in which the intrinsics and distortion `lens` (P,) are adjusted, L from 0 to 2.

    One is a common scale of fx and fy, unless the rig file fixes them or states a prior. The other is the first
    coefficient of distortion, which has the largest effect, unless the rig file has a distortion.
    """
    rows = np.zeros((2, len(lens)))
    rows[0, :2], rows[1, 4] = lens[:2], 1.0
    return rows[[known_value(camera.intrinsics) is None, camera.distortion.value is None]]
