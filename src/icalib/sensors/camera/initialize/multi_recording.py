"""First guesses of several recordings: the calibration from the one that shows most, and held for the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import CalibrationError, EstimationError
from icalib.geometry.cameras import camera_model
from icalib.initialize.steps.rate_alignment import OneAxisError, camera_rates, contradicting_offset
from icalib.model.bodies import Bodies
from icalib.motion.imu_data import imu_data
from icalib.rig import Camera, Rig
from icalib.sensors.camera.initialize.boards.moved_bodies import check_bodies_still
from icalib.sensors.camera.initialize.boards.scene_intrinsics import find_scene
from icalib.sensors.camera.initialize.boards.target_scene import TargetScene, scene_poses
from icalib.sensors.camera.initialize.guess import CameraGuess, Guess
from icalib.sensors.camera.initialize.target_with_imu import initial_guess
from icalib.sensors.camera.initialize.tracks.from_tracks import guess_from_tracks
from icalib.sensors.parameter import fixed


def initial_guesses(rig: Rig, bodies: Bodies, recordings: Sequence[Measurements]) -> tuple[Guess, ...]:
    """A guess for each recording, all with the same calibration and the same scene.

    Raises EstimationError, one sentence; where there are several recordings it names the one that carries no guess, or
    whose clocks stand elsewhere.
    """
    if not rig.has_target:
        return _guesses_from_tracks(rig, recordings)
    scene = find_scene(rig, bodies, recordings)
    if len(recordings) == 1:
        return (initial_guess(rig, recordings[0], scene),)
    check_bodies_still(rig, scene, recordings)
    order = sorted(range(len(recordings)), key=lambda k: -sum(len(c.stamps_ns) for c in recordings[k].cameras))
    best, guess = _first_that_works(rig, scene, [(k, recordings[k]) for k in order])
    held = _held(rig, guess, recordings[best])
    guesses = []
    for k, recording in enumerate(recordings):
        if k == best:
            guesses.append(guess)
            continue
        _check_clocks(rig, scene, guess, recordings[best], recording)
        guesses.append(_named(held, scene, recording))
    return tuple(guesses)


def _guesses_from_tracks(rig: Rig, recordings: Sequence[Measurements]) -> tuple[Guess, ...]:
    """The calibration from the recording that shows most, and held for the others."""
    best = max(recordings, key=lambda r: sum(len(t.uv) for t in r.tracks))
    guess = guess_from_tracks(rig, best)
    held = _held(rig, guess, best)
    return tuple(guess if r is best else guess_from_tracks(held, r) for r in recordings)


def _first_that_works(rig: Rig, scene: TargetScene, recordings: list[tuple[int, Measurements]]) -> tuple[int, Guess]:
    """The calibration needs one recording that shows all of it; the error is that of the one that showed most."""
    failed: list[EstimationError] = []
    for k, recording in recordings:
        try:
            return k, _named(rig, scene, recording)
        except EstimationError as error:
            failed.append(error)
    raise failed[0]


def _named(rig: Rig, scene: TargetScene, recording: Measurements) -> Guess:
    try:
        return initial_guess(rig, recording, scene)
    except CalibrationError as error:
        named = OneAxisError if isinstance(error, OneAxisError) else EstimationError
        raise named(f"{recording.name}: {error}") from error


def _held(rig: Rig, guess: Guess, recording: Measurements) -> Rig:
    """The rig with the calibration of `guess`, made from `recording`, fixed, but for clocks that restart."""

    def camera(c: Camera, found: CameraGuess, origin_ns: int) -> Camera:
        offset = found.offset - (origin_ns - recording.origin_ns) * 1e-9
        return dataclasses.replace(
            c,
            rotation=fixed(found.rotation),
            translation=fixed(found.position),
            time_offset=c.time_offset if c.clock_restarts else fixed(np.array([offset])),
            intrinsics=fixed(found.params[:4]),
            distortion=fixed(found.params[4:]),
        )

    pairs = zip(rig.cameras, recording.cameras, strict=True)
    return rig.with_sensors(*(camera(c, guess.cameras[c.name], s.origin_ns) for c, s in pairs))


def _check_clocks(rig: Rig, scene: TargetScene, guess: Guess, reference: Measurements, recording: Measurements) -> None:
    """Raises EstimationError where a camera and the IMU turn alike at another time offset than in `reference`, which
    `guess` was made from."""
    imu = imu_data(rig, recording)
    if imu is None:
        return
    for camera, stream, before in zip(rig.cameras, recording.cameras, reference.cameras, strict=True):
        if camera.clock_restarts:
            continue
        known = guess.cameras[camera.name]
        origins_ns = (stream.origin_ns - recording.origin_ns) - (before.origin_ns - reference.origin_ns)
        expected = known.offset + origins_ns * 1e-9
        poses = scene_poses(stream, camera_model(camera.model), known.params, scene)
        try:
            rates = camera_rates(stream, poses)
        except EstimationError as error:
            raise EstimationError(f"{recording.name}: {error}") from error
        found = contradicting_offset(imu, camera.name, rates, expected)
        if found is not None:
            raise EstimationError(
                f"{recording.name}: the time offset of {camera.name} differs by {found - expected:+.3f} s from "
                f"that in {reference.name}. If a clock was set or restarted in between, write clock_restarts: "
                "true for the sensor in the rig file; else calibrate this recording alone."
            )
