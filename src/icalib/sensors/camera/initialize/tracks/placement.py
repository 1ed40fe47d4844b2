"""Cameras that follow points, placed on a motion that other sensors have shown: see `track_mount`."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from icalib.estimate.problem.assembly import motion_of
from icalib.estimate.problem.inputs import Inputs
from icalib.geometry.cameras import camera_model
from icalib.initialize.steps.rate_alignment import main_axis, rough_alignments
from icalib.initialize.steps.rate_regression import matching_track_rates
from icalib.initialize.steps.rig_file_values import known_value, stated_values
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
from icalib.sensors.sensor import MOUNTED_NAMES, mounted


def track_camera_values(inputs: Inputs, state: State) -> dict[Key, np.ndarray]:
    """Of all cameras, which follow points, `state` having the motion: what the rig gives, or what their tracks show.

    Raises EstimationError where neither does.
    """

    def values(number: int) -> dict[Key, np.ndarray]:
        camera, best = inputs.rig.cameras[number], fullest_recording(inputs, inputs.measurements.tracks[number].key)
        with naming_recording(inputs, best):
            lens = _lens(inputs, number, best)
        known = stated_values(inputs, camera)
        guessed = {(camera.name, "intrinsics"): lens[:4], (camera.name, "distortion"): lens[4:]}
        return guessed | (_placed(inputs, state, number, lens) if len(known) < len(MOUNTED_NAMES) else {}) | known

    with ThreadPoolExecutor(N_THREADS) as pool:  # its own: what it does may use the solver's
        return {k: v for own in pool.map(values, range(len(inputs.rig.cameras))) for k, v in own.items()}


def _lens(inputs: Inputs, number: int, recording: int) -> np.ndarray:
    """(P,) where a lens is sought from."""
    own = single_recording(inputs, recording)
    assert own.imu is not None
    return start_intrinsics(inputs.rig.cameras[number], own.measurements.tracks[number], own.imu, own.measurements)


def _placed(inputs: Inputs, state: State, number: int, lens: np.ndarray) -> dict[Key, np.ndarray]:
    """Where a camera stands, and its lens, sought from `lens` (P,). Of several recordings the one in which it saw most
    says so."""
    camera, best = inputs.rig.cameras[number], fullest_recording(inputs, inputs.measurements.tracks[number].key)
    mount_in = partial(_mount_in, inputs, state, number, lens)
    with naming_recording(inputs, best):
        found, lens = mount_in(best)
    if camera.clock_restarts:
        offset = offset_of_each_clock(inputs, camera.name, lambda k: mount_in(k, found)[0].offset, {best: found.offset})
    else:
        offset = np.array([converted_offset(found.offset, camera.name, single_recording(inputs, best), inputs)])
    values = mounted(found.rotation, found.position, offset) | {"intrinsics": lens[:4], "distortion": lens[4:]}
    return {(camera.name, name): np.ascontiguousarray(value) for name, value in values.items()}


def _mount_in(
    inputs: Inputs, state: State, number: int, lens: np.ndarray, recording: int, placed: CameraExtrinsics | None = None
) -> tuple[CameraExtrinsics, np.ndarray]:
    """Mount and lens, as one recording shows them; `placed`: how the camera stands, where another has shown it."""
    own, camera = single_recording(inputs, recording), inputs.rig.cameras[number]
    assert own.imu is not None
    stream, model = own.measurements.tracks[number], camera_model(camera.model)
    known = {name: value for (_, name), value in stated_values(own, camera).items()}
    if placed is not None:
        known |= {"rotation": placed.rotation, "translation": placed.position}
    offsets = [float(known["time_offset"][0])] if "time_offset" in known else None
    same_clock = relative_offset(np.zeros(1), own.measurements.cameras[number], own.measurements)
    followed = ImagePairs.of(stream, model, lens, _open(camera, lens))
    bent = np.zeros(len(followed.bends))
    starts = [
        CameraExtrinsics(known.get("rotation", a.rotation), known.get("translation", np.zeros(3)), a.offset, bent)
        for a in rough_alignments(
            own.imu, camera.name, matching_track_rates(own.imu, stream, model, lens), offsets, same_clock
        )
    ]
    motion = motion_of(own, state_of_recording(inputs, recording, state))
    held = np.repeat([name in known for name in MOUNTED_NAMES], [3, 3, 1])
    axis = None if "rotation" in known else main_axis(own.imu.gyro)
    found = extrinsics_on_motion(followed, motion, starts, axis, held)
    return found, followed.lens_of(found)


def _open(camera: Camera, lens: np.ndarray) -> np.ndarray:
    """(L, P) directions in which the lens is sought: longer, unless the rig file is sure of it, and another first
    coefficient of distortion, which bends most, where the rig file has none."""
    rows = np.zeros((2, len(lens)))
    rows[0, :2], rows[1, 4] = lens[:2], 1.0
    return rows[[known_value(camera.intrinsics) is None, camera.distortion.value is None]]
