"""The calibration pipeline: reading, initial guess, optimization, assessment of the result."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial, reduce
from math import inf
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from icalib.data.measurements import Measurements, streams_of_rig
from icalib.data.recording import Progress
from icalib.data.recordings import Recording, Source, naming, noting, open_all, read_measurements, without_jumps
from icalib.errors import EstimationError, RecordingError
from icalib.estimate.inputs import Inputs
from icalib.estimate.problem import Problem
from icalib.estimate.solver import Visit
from icalib.initialize.rig_guess import Attempt, attempt, solved
from icalib.kinds import readers
from icalib.optim.memory import set_mmap_threshold, trim_heap
from icalib.result import Calibration, Visited
from icalib.result.pictures import pictures
from icalib.result.saving import provenance
from icalib.rig import Rig
from icalib.rig.file import check_complete, load_rig
from icalib.validation import assess, stated_words, visited

READING_SHARE, DETECTION_SHARE = 0.1, 0.8  # of the total time, without and with detection in images
# of the prior uncertainty of a guess: no standard deviation is larger, but that of singular normal equations
SINGULAR_SIGMA = 1e3
SHORTEST_S = 1.0  # shortest IMU stream that is accepted; time offsets need 4 s


def calibrate(
    rig: Rig | str | Path,
    recording: Source | Sequence[Source],
    progress: Progress = lambda *_: None,
    *,
    start_s: float = 0.0,
    end_s: float = inf,
) -> Calibration:
    """Calibrates all sensors of `rig` from `recording`, or jointly from several recordings of the same rig.

    rig: a Rig, or the path of a rig file. recording: opened recordings, or paths. start_s, end_s: used part of each
    recording, in seconds from its start. progress: called with the stage and the completed fraction.

    Raises CalibrationError; if there are several recordings, the message names the one concerned. Its `__notes__` list
    data that were rejected or repaired before.
    """
    rig = rig if isinstance(rig, Rig) else load_rig(rig)
    check_complete(rig)
    set_mmap_threshold()
    opened = open_all(recording, start_s, end_s)
    started = time.perf_counter()
    share = _reading_share(rig, opened)
    measurements = _measure_all(rig, opened, lambda stage, done: progress(stage, share * done))
    read = time.perf_counter() - started
    with noting(note for m in measurements for note in m.notes):
        result = calibrate_measurements(
            rig, measurements, lambda stage, done: progress(stage, share + (1.0 - share) * done)
        )
    files = [file for r in opened.values() for file in r.files()]
    inputs = provenance([*([rig.path] if rig.path else []), *files])
    timings = {"reading": read} | result.timings | {"all": time.perf_counter() - started}
    return dataclasses.replace(result, inputs=inputs, timings=timings)


def measure(
    rig: Rig,
    recording: Source | Sequence[Source],
    progress: Progress = lambda *_: None,
    *,
    start_s: float = 0.0,
    end_s: float = inf,
) -> list[Measurements]:
    """Reads and checks the data of all sensors of `rig`, one `Measurements` per recording, for
    `calibrate_measurements`. Parameters and errors as `calibrate`."""
    check_complete(rig)
    return _measure_all(rig, open_all(recording, start_s, end_s), progress)


def _reading_share(rig: Rig, opened: Mapping[str, Recording]) -> float:
    """Expected fraction of the calibration time that reading takes, for the progress display."""
    pairs = ((r, s) for r in opened.values() for s in rig.sensors.values())
    detection = any(readers()[s.sensor_type].needs_detection(r, s, rig.has_target) for r, s in pairs)
    return DETECTION_SHARE if detection else READING_SHARE


def _measure_all(rig: Rig, opened: Mapping[str, Recording], progress: Progress) -> list[Measurements]:
    measurements = []
    for one in opened.values():
        one.use_layouts(tuple(rig.sensors.values()))
    for k, (name, one) in enumerate(opened.items()):

        def show(stage: str, done: float, k: int = k) -> None:
            progress(stage, (k + done) / len(opened))

        with naming(name if len(opened) > 1 else ""):
            measurements.append(dataclasses.replace(read_measurements(one, rig, show), name=name))
    return measurements


def calibrate_measurements(
    rig: Rig,
    measurements: Measurements | Sequence[Measurements],
    progress: Progress = lambda *_: None,
    on_visit: Callable[[Visited], None] | None = None,
) -> Calibration:
    """As `calibrate`, from measurements in memory. Measurements without a name are numbered.

    on_visit: called with each state from which the solver computes a step. Raises CalibrationError as `calibrate`, and
    if a sensor of the rig has no stream.
    """
    given = [measurements] if isinstance(measurements, Measurements) else measurements
    if not given:
        raise RecordingError("no recording was given; give at least one.")
    check_complete(rig)
    recordings = [m if m.name else dataclasses.replace(m, name=f"recording {k}") for k, m in enumerate(given, 1)]
    recordings = [without_jumps(rig, streams_of_rig(rig, m)) for m in recordings]
    for one in recordings:
        _refuse_short(one)
    # Kernels run in several threads; additional BLAS threads would double the time.
    with threadpool_limits(limits=1, user_api="blas"):
        try:
            return _calibrate(rig, recordings, progress, on_visit)
        except (np.linalg.LinAlgError, OverflowError) as error:
            raise EstimationError(
                f"the equations have no solution ({error}). A value in the recording or in the rig file has an "
                "implausible size, or nothing in the recording moves; check both with icalib inspect."
            ) from error


def _refuse_short(measured: Measurements) -> None:
    imu = measured.imu
    duration_s = 0.0 if imu is None else float(imu.stamps_ns[-1] - imu.stamps_ns[0]) * 1e-9
    if imu is not None and duration_s < SHORTEST_S:
        raise EstimationError(
            f"{imu.name}: the recording is too short ({len(imu.stamps_ns)} readings in {duration_s:.2f} s); record "
            "some seconds of motion."
        )


def _calibrate(
    rig: Rig, recordings: Sequence[Measurements], progress: Progress, on_visit: Callable[[Visited], None] | None
) -> Calibration:
    clock = _Clock()
    progress("estimating the initial guess", 0.0)
    set_mmap_threshold()
    trim_heap()
    steps = _StepProgress(progress)

    def report_visit(inputs: Inputs, stage: str, problem: Problem, visit: Visit) -> None:
        if on_visit is not None:
            on_visit(visited(inputs, stage, problem, visit))

    solve = partial(solved, on_step=lambda name, step: steps.note(name), on_visit=report_visit)

    def make(rig: Rig) -> Attempt:
        best_attempt = attempt(rig, recordings, clock.lap, solve)
        if best_attempt.error is not None:
            raise EstimationError(
                " Besides, ".join(stated_words(best_attempt.inputs, c) for c in best_attempt.against)
            ) from best_attempt.error
        clock.lap("solving")
        progress("assessing the result", 0.9)
        return best_attempt

    best_attempt, result = _assessed(rig, make)
    _refuse_no_numbers(result, rig)
    lidars = [s.name for s in rig.sensors.values() if s.shows_planes]
    if best_attempt.inputs.association.at_rest:  # of a recording that goes on between the stops only these
        recordings = [motion.measurements for motion in best_attempt.inputs.motions]
    result = dataclasses.replace(result, pictures=tuple(pictures(result, lidars, recordings)))
    clock.lap("judging")
    return dataclasses.replace(result, timings=clock.laps, made=datetime.now(UTC).isoformat(timespec="seconds"))


def _assessed(rig: Rig, make: Callable[[Rig], Attempt]) -> tuple[Attempt, Calibration]:
    """The attempt and its result. If the recording shows effects that the rig lacks, those of the rig with them."""
    first = make(rig)
    result, remedies = assess(first.inputs, first.solution, first.against)
    if remedies:
        with suppress(EstimationError):
            second, better = _assessed(reduce(lambda rig, remedy: remedy.amended(rig), remedies, rig), make)
            if second.converged:
                notes = tuple(remedy.note for remedy in remedies if remedy.note is not None)
                return second, dataclasses.replace(better, notes=(*better.notes, *notes))
    return first, result


def _refuse_no_numbers(result: Calibration, rig: Rig) -> None:
    """Raises EstimationError for an estimate that is not finite or a NaN sigma, as implausible input values overflow,
    and for standard deviations that only singular normal equations have."""
    for group in result.groups:
        sensor = rig.sensors.get(group.sensor)
        limit = np.inf if sensor is None else SINGULAR_SIGMA * sensor.spec(group.name).prior_sigma
        if group.std.max(initial=0.0) > limit:
            raise EstimationError(
                f"{group.sensor}: the normal equations of {group.name.replace('_', ' ')} are singular to within "
                "rounding, so that it has no standard deviation. The noise in the rig file is too small, or the motion "
                "too poor: state noise that the sensors have, or record more turns and accelerations."
            )
        if not np.isfinite(group.value).all() or np.isnan(group.std).any():
            raise EstimationError(
                f"{group.sensor}: the estimate of {group.name} is not finite, because a value in the recording "
                "or in the rig file has an implausible size; check both with icalib inspect."
            )


class _Clock:
    """Stopwatch: wall time [s] of each stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + now - self._last
        self._last = now


class _StepProgress:
    """Progress display of the solver. The number of steps is unknown: each adds 12 % of the distance left to 0.9."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._done = progress, 0.1

    def note(self, name: str) -> None:
        self._done += 0.12 * (0.9 - self._done)
        self._progress(f"solving ({name} pass)", self._done)
