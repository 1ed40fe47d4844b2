"""From a recording to a calibration: this page is the algorithm."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

from threadpoolctl import threadpool_limits

from icalib.assessment import assess
from icalib.calibration import Calibration
from icalib.detection.streams import find_corners
from icalib.estimation.assembly import Inputs, image_times, layout_for, nodes_for, start_values
from icalib.estimation.estimate import estimate
from icalib.estimation.imu_data import imu_data
from icalib.estimation.state import State
from icalib.estimation.tolerances import Tolerances
from icalib.first_guess import Guess, initial_guess, initial_trajectory
from icalib.measurements import CornerStream, Measurements
from icalib.provenance import provenance
from icalib.recordings import Recording, open_recording, read_measurements
from icalib.rig import Camera, Rig
from icalib.rig_file import load_rig

READING_SHARE, IMAGES_SHARE = 0.1, 0.8  # of the time, without images and with
Progress = Callable[[str, float], None]  # what is being done, and how much of the whole is behind, 0 to 1


def calibrate(
    rig: Rig | str | Path, recording: Recording | str | Path, progress: Progress = lambda *_: None
) -> Calibration:
    """Calibrates every sensor of `rig` from `recording`. Both may be paths. Raises CalibrationError, one sentence."""
    rig = rig if isinstance(rig, Rig) else load_rig(rig)
    recording = open_recording(recording) if isinstance(recording, (str, Path)) else recording
    started = time.perf_counter()
    pictured = any(not recording.has_corners(c) for c in rig.cameras)
    share = IMAGES_SHARE if pictured else READING_SHARE
    measurements = _measure(rig, recording, lambda stage, done: progress(stage, share * done))
    read = time.perf_counter() - started
    result = calibrate_measurements(
        rig, measurements, lambda stage, done: progress(stage, share + (1.0 - share) * done)
    )
    inputs = provenance([*([rig.path] if rig.path else []), *recording.files()])
    timings = {"reading": read} | result.timings | {"all": time.perf_counter() - started}
    return dataclasses.replace(result, inputs=inputs, timings=timings)


def _measure(rig: Rig, recording: Recording, progress: Progress) -> Measurements:
    """What the recording holds of each sensor; corners are found in images where it holds these."""
    names = [c.name for c in rig.cameras]
    progress("reading", 0.0)

    def find(recording: Recording, camera: Camera) -> tuple[CornerStream, tuple[str, ...]]:
        def show(done: float) -> None:
            share = (names.index(camera.name) + done) / len(names)
            progress(f"finding the target in the images of {camera.name}", share)

        return find_corners(recording, camera, rig.target, rig.settings.keep_corners, show)

    return read_measurements(recording, rig, find)


def calibrate_measurements(rig: Rig, measurements: Measurements, progress: Progress = lambda *_: None) -> Calibration:
    """As `calibrate`, from measurements in memory."""
    # The kernels have threads of their own; those of BLAS beside them double the time.
    with threadpool_limits(limits=1, user_api="blas"):
        return _calibrate(rig, measurements, progress)


def _calibrate(rig: Rig, measurements: Measurements, progress: Progress) -> Calibration:
    clock = _Clock()
    progress("finding a first guess", 0.0)
    guess = initial_guess(rig, measurements)
    clock.lap("first guess")
    inputs = Inputs(rig, measurements, imu_data(rig, measurements), layout_for(rig), Tolerances())
    state = first_state(inputs, guess)
    clock.lap("first state")
    steps = _StepProgress(progress)
    found = estimate(inputs, state, lambda name, step: steps.note(name))
    clock.lap("solving")
    progress("judging the result", 0.9)
    result = assess(inputs, found)
    clock.lap("judging")
    return dataclasses.replace(result, timings=clock.laps)


def first_state(inputs: Inputs, guess: Guess) -> State:
    """The state that the first pass starts from: the guess at all nodes."""
    values = start_values(inputs, guess.values())
    nodes = nodes_for(inputs, image_times(inputs, values))
    rotation, position, velocity = initial_trajectory(guess, inputs.rig, inputs.measurements, nodes)
    return State(nodes, rotation, position, velocity, guess.biases(len(nodes)), values)


class _Clock:
    """Wall time by stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now


class _StepProgress:
    """Progress of the solver: each step goes part of the way that is left."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._done = progress, 0.1

    def note(self, name: str) -> None:
        self._done += 0.12 * (0.9 - self._done)
        self._progress(f"solving ({name} pass)", self._done)
