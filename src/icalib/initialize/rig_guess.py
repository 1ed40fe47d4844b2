"""The initial guess: inputs of the estimate, and the state at which its first pass starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from icalib.data.measurements import Measurements, PoseStream
from icalib.errors import EstimationError
from icalib.estimate.estimate import Callbacks
from icalib.estimate.inputs import Inputs, groups_of, inputs_for, usual, with_groups
from icalib.estimate.problem import Problem, keyframe_times, keyframes_for, resample, start_values
from icalib.estimate.residual_statistics import chi2_by_kind
from icalib.estimate.solver import Step, Visit
from icalib.initialize.assumed_motion import ASSUMED_POSES, guess_with_assumed_motion, pose_sensor_for
from icalib.initialize.initializer import (
    FailedEstimate,
    FarOffError,
    InitialGuess,
    Initializer,
    OtherMotionError,
    UnusableMeasurementsError,
    Values,
    inputs_of_sensors,
    is_contradicted,
    keyframe_hosts,
    kinds_of,
    motion_kinds,
    place_sensors,
    refusing_far_off,
    sources_of,
)
from icalib.observability.contradictions import Contradiction, contradicted_by
from icalib.observability.determination import Determined, determine
from icalib.optim.arrowhead import NotDefiniteError
from icalib.optim.memory import trim_heap
from icalib.optim.state import State
from icalib.rig import LENS, Parameter, Rig, Sensor


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
        recordings = kind.prepared(rig, recordings)
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
    inputs = inputs_for(rig, recordings)
    source, source_inputs, state = _trajectory(inputs, recordings, motion_kinds(rig))
    lap("first guess")
    if source_inputs is inputs and not source.refined_alone:
        return inputs, state, state.values
    guess = _align_to_trajectory(source, source_inputs.rig, *source.refined(inputs, source_inputs, state))
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
    source_inputs = inputs_of_sensors(inputs, recordings, sources_of(kind, inputs.rig))

    def fallback() -> tuple[Inputs, State]:
        return _trajectory(inputs, recordings, fallbacks)[1:]

    try:
        return kind, source_inputs, kind.trajectory(source_inputs, fallback)
    except EstimationError as error:
        can_do_without = inputs.rig.wheels and not inputs.rig.lidars
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
    names = [s.name for s in (imu, *inputs.rig.further_imus)]
    others = [m.without(*names) for m in recordings]
    try:
        assumed, state, _ = guess_with_assumed_motion(inputs.rig.without(*names), others)
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
    source: Initializer[Any], source_rig: Rig, inputs: Inputs, state: State, guess: Values
) -> InitialGuess:
    """The initial guess for all sensors of `inputs`, from the trajectory in `state` by the sensors of `source_rig`. All
    other sensors are aligned to it. guess: of the parameters in `state`."""
    rig = inputs.rig
    unplaced = [s for s in rig.mounted if s.name not in source_rig.sensors]
    hosts = keyframe_hosts(unplaced)
    placed = place_sensors(inputs, state, hosts)
    if hosts or source.moves_keyframes:
        values = start_values(inputs, state.values | placed)
        state = resample(replace(state, values=values), keyframes_for(inputs, keyframe_times(inputs, values)), inputs)
    placed |= place_sensors(inputs, state, [s for s in unplaced if s not in hosts])
    started = start_values(inputs, placed)
    state, guess = replace(state, values=started | state.values | placed), started | guess | placed
    for kind in kinds_of(rig):
        if kind is not source:
            inputs, state, changed = kind.associated(inputs, state)
            guess = guess | changed
    return inputs, state, guess


# Estimates a rig, with fallbacks if the estimate fails or fits poorly: without guesses, then without any stated value.
#
# Guesses have no weight in the estimate. If they lead to a wrong minimum, an estimate without them replaces the first.
# Fixed values and priors have weight. If they spoil the estimate, one without them shows which values contradict the
# data.

POOR_FIT_RATIO = 4.0  # RMS residual over stated noise, of any kind of residuals, above which fallbacks are tried
CLEARLY_BETTER_RATIO = 0.5  # largest misfit of a fallback, relative to that of the first estimate, at which it is used
OnVisit = Callable[[Inputs, str, Problem, Visit], None]


@dataclass(frozen=True)
class Attempt:
    """An estimate of a rig. against: values of the rig file that contradict an estimate without them; error: why the
    estimate with these values failed, or None."""

    inputs: Inputs
    solution: Determined
    against: tuple[Contradiction, ...] = ()
    error: EstimationError | None = None

    @property
    def converged(self) -> bool:
        """Whether the solver converged."""
        return self.solution.estimate.outcome.converged

    @property
    def misfit(self) -> float:
        """The largest ratio, over all kinds of residuals, of their RMS to the stated noise; infinite if not
        converged."""
        outcome = self.solution.estimate.outcome
        statistics = chi2_by_kind(outcome.problem, outcome.residuals).values()
        return max((np.sqrt(chi2 / max(n, 1)) for n, chi2 in statistics), default=0.0) if outcome.converged else np.inf


Solve = Callable[[Inputs, State, Values], Attempt]


def attempt(rig: Rig, recordings: Sequence[Measurements], lap: Callable[[str], None], solve: Solve) -> Attempt:
    """The estimate of `rig`, or a fallback. An estimate without guesses replaces one that fails or fits poorly, if it
    fits clearly better. Otherwise the first estimate is returned, with the stated values that contradict the data. If
    it failed, the estimate without any stated values takes its place.

    lap: called at the end of each stage. solve: `solved`, with progress of the solver. Raises EstimationError if the
    data do not determine an estimate.
    """

    def make(rig: Rig) -> Attempt:
        return solve(*guess_of_rig(rig, recordings, lap))

    try:
        with refusing_far_off():
            first, failed = _attempt_or_error(rig, make)
    except FarOffError as error:
        if (fallback := _contradicting_attempt(rig, make)) is not None:
            return replace(fallback, error=error)
        first, failed = _attempt_or_error(rig, make)
    misfit = np.inf if first is None else first.misfit
    if first is not None and misfit < POOR_FIT_RATIO:
        return first
    fallback = _without_guesses(rig, make, solve)
    if fallback is not None and fallback.misfit < CLEARLY_BETTER_RATIO * misfit:
        return fallback
    fallback = _contradicting_attempt(rig, make)
    if fallback is not None and fallback.misfit < CLEARLY_BETTER_RATIO * misfit:
        return replace(fallback, error=failed) if first is None else replace(first, against=fallback.against)
    if first is None:
        assert failed is not None
        raise explained_failure(rig, recordings, make, failed)
    return first


def _attempt_or_error(rig: Rig, make: Callable[[Rig], Attempt]) -> tuple[Attempt, None] | tuple[None, EstimationError]:
    """The attempt, or the error why it failed. Raises FarOffError."""
    try:
        return make(rig), None
    except FarOffError:
        raise
    except EstimationError as error:
        return None, error


def explained_failure(
    rig: Rig, recordings: Sequence[Measurements], make: Callable[[Rig], Attempt], failed: EstimationError
) -> EstimationError:
    """The error with the cause of a breakdown, if the kind of sensor that gave the motion knows one; else `failed`."""
    if not isinstance(failed, NotDefiniteError):
        return failed
    estimate = FailedEstimate(rig, recordings, failed, lambda changed: _converged_attempt(changed, make) is not None)
    return motion_kinds(rig)[0].explained(estimate) or failed


def solved(
    inputs: Inputs, state: State, guess: Values, on_step: Callable[[str, Step], None], on_visit: OnVisit
) -> Attempt:
    """The estimate from an `InitialGuess`. Raises EstimationError."""
    trim_heap()
    try:
        solution = determine(inputs, state, guess, Callbacks(on_step, partial(on_visit, inputs)))
    except EstimationError as error:
        failed = FailedEstimate(inputs.rig, [inputs.measurements], error)
        if (reason := next(filter(None, (kind.explained(failed) for kind in kinds_of(inputs.rig))), None)) is not None:
            raise reason from error
        raise
    return Attempt(inputs, solution)


def _without_guesses(rig: Rig, make: Callable[[Rig], Attempt], solve: Solve) -> Attempt | None:
    """The estimate without guesses. If parameters are unobservable then, `solve` repeats it from its own state, with
    these parameters reset to the guesses that agree with it. None if the rig has no guesses, or the estimate fails."""
    fallback = _without_values(rig, make, lambda p: p.mode == "free") if _has_values(rig, "free") else None
    if fallback is None:
        return None
    inputs, state = fallback.inputs, fallback.solution.estimate.outcome.state

    def agreeing(sensor: Sensor, name: str, p: Parameter) -> Parameter:
        stated = getattr(rig.sensors.get(sensor.name), name, p)
        if p.mode != "free" or stated.value is None or name == "time_offset":
            return p
        estimate = state.values.get((sensor.name, name), stated.value)
        return p if is_contradicted(sensor.spec(name), stated.value, estimate) else stated

    agreeing_rig = with_groups(inputs.rig, agreeing)
    if fallback.solution.fixed_directions.size and _has_values(agreeing_rig, "free"):
        inputs = replace(inputs, rig=agreeing_rig)
        guess = {
            (sensor.name, name): p.value
            for sensor, name, p in groups_of(agreeing_rig)
            if p.mode == "free" and p.value is not None and (sensor.name, name) in state.values
        }
        with suppress(EstimationError):
            refined = solve(inputs, state, guess)
            fallback = refined if refined.converged else fallback
    return replace(fallback, inputs=replace(fallback.inputs, user_rig=rig))


def _without_values(rig: Rig, make: Callable[[Rig], Attempt], dropped: Callable[[Parameter], bool]) -> Attempt | None:
    """The estimate without the values that `dropped` selects. If it fails, and cameras have feature tracks only, their
    intrinsics are kept as guesses, because not every motion makes them observable. None if it fails again."""

    def bare(lens: bool) -> Rig:
        def treated(sensor: Sensor, name: str, p: Parameter) -> Parameter:
            if p.value is None or not dropped(p) or sensor.spec(name).is_considered or sensor is rig.imu:
                # What a recording hardly shows explains no failure, and an IMU any: even a target of another size.
                return p
            return Parameter("free", p.value) if lens and name in LENS else usual(sensor, name)

        return with_groups(rig, treated)

    fallback = _converged_attempt(bare(False), make)
    return fallback if fallback is not None or rig.has_target else _converged_attempt(bare(True), make)


def _contradicting_attempt(rig: Rig, make: Callable[[Rig], Attempt]) -> Attempt | None:
    """The estimate without any value of the rig file, with the fixed values and priors that contradict it. None if the
    rig file has none, the estimate fails, or it contradicts none."""
    if not (_has_values(rig, "fixed") or _has_values(rig, "prior")):
        return None
    fallback = _without_values(rig, make, lambda p: True)
    if fallback is None:
        return None
    against = contradicted_by(replace(fallback.inputs, user_rig=rig), fallback.solution)
    return replace(fallback, against=against) if against else None


def _has_values(rig: Rig, mode: str) -> bool:
    """Whether the rig file gives a value with this mode that an estimate may drop."""
    return any(p.mode == mode and p.value is not None for s, _, p in groups_of(rig) if s is not rig.imu)


def _converged_attempt(rig: Rig, make: Callable[[Rig], Attempt]) -> Attempt | None:
    """The attempt if it converges, else None."""
    try:
        result = make(rig)
    except EstimationError:
        return None
    return result if result.converged else None


# Detects streams that were recorded at different times, by stamps in Unix time.

FIRST_UNIX_NS = 10**18  # September 2001; earlier stamps are no Unix time and are not compared
HOUR_S = 3600.0  # s between the streams, above which they count as recorded at different times


@contextmanager
def naming_recording_times(recordings: Sequence[Measurements]) -> Iterator[None]:
    """A context for errors of streams that were not recorded together. An OtherMotionError is replaced by one that
    names two streams of a recording more than an hour apart, if there are any."""
    try:
        yield
    except OtherMotionError as error:
        for recording in recordings:
            if (streams := furthest_apart(recording)) is not None:
                raise EstimationError(_sentence(*streams)) from error
        raise


def furthest_apart(recording: Measurements) -> tuple[str, str, float] | None:
    """Names of two sensors, and the time [s] from the last stamp of the first to the first stamp of the second. None if
    this is at most an hour for all pairs."""
    spans = [
        (int(s.stamps_ns[0]), int(s.stamps_ns[-1]), s.name)
        for s in recording.streams.values()
        if len(s.stamps_ns) and s.stamps_ns[0] > FIRST_UNIX_NS
    ]
    if not spans:
        return None
    (_, end, first), (begin, _, second) = min(spans, key=lambda s: s[1]), max(spans, key=lambda s: s[0])
    gap = 1e-9 * (begin - end)
    return (first, second, gap) if gap > HOUR_S else None


def _sentence(first: str, second: str, gap: float) -> str:
    days, hours = gap / 86400.0, gap / HOUR_S
    delay = f"{days:.1f} days" if days >= 2.0 else f"{hours:.1f} hours"
    return (
        f"{second} was recorded {delay} after {first}, by the stamps of both, and does not show the same motion; give "
        "the files of one recording."
    )
