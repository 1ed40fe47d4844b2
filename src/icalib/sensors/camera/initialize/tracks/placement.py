"""Calibration parameters of cameras with feature tracks, on a trajectory from other sensors."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from icalib.estimate.problem.assembly import motion_of
from icalib.estimate.problem.inputs import Inputs
from icalib.geometry.cameras import camera_model
from icalib.initialize.steps.contradicted_guesses import known_value, stated_values
from icalib.initialize.steps.rate_alignment import main_axis, rough_alignments
from icalib.initialize.steps.single_recording import (
    converted_offset,
    fullest_recording,
    naming_recording,
    offset_of_each_clock,
    single_recording,
    state_of_recording,
)
from icalib.optim.arrowhead import N_THREADS
from icalib.optim.state import Key, State
from icalib.rig import Camera
from icalib.sensors.camera.initialize.guess import relative_offset
from icalib.sensors.camera.initialize.tracks.epipolar_extrinsics import (
    CameraExtrinsics,
    ImagePairs,
    extrinsics_on_motion,
)
from icalib.sensors.camera.initialize.tracks.from_tracks import start_intrinsics
from icalib.sensors.camera.initialize.tracks.joint_alignment import matching_track_rates
from icalib.sensors.sensor import MOUNTED_NAMES, mounted


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
