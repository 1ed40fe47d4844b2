"""Estimates a rig, with fallbacks if the estimate fails or fits poorly: without guesses, then without any stated value.

Guesses have no weight in the estimate. If they lead to a wrong minimum, an estimate without them replaces the first.
Fixed values and priors have weight. If they spoil the estimate, one without them shows which values contradict the
data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.estimate.estimate import Callbacks
from icalib.estimate.problem.groups import groups_of, with_groups
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.problem.outcome import Step, Visit
from icalib.estimate.problem.problem import Problem
from icalib.estimate.residual_statistics.fit_statistics import chi2_by_kind
from icalib.initialize.rig_guess import guess_of_rig
from icalib.initialize.steps.contradicted_guesses import FarOffError, is_contradicted, refusing_far_off
from icalib.initialize.steps.initializer import kinds_of, motion_kinds
from icalib.observability.contradictions import Contradiction, contradicted_by
from icalib.observability.determination import Determined, determine
from icalib.optim.arrowhead import NotDefiniteError
from icalib.optim.memory import trim_heap
from icalib.rig import LENS, Parameter, Rig, Sensor

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


def attempt(
    rig: Rig,
    recordings: Sequence[Measurements],
    lap: Callable[[str], None],
    on_step: Callable[[str, Step], None],
    on_visit: OnVisit,
) -> Attempt:
    """The estimate of `rig`, or a fallback. An estimate without guesses replaces one that fails or fits poorly, if it
    fits clearly better. Otherwise the first estimate is returned, with the stated values that contradict the data. If
    it failed, the estimate without any stated values takes its place.

    lap, on_step, on_visit: progress of stages and solver. Raises EstimationError if the data do not determine an
    estimate.
    """
    make = partial(_make_attempt, recordings=recordings, lap=lap, on_step=on_step, on_visit=on_visit)
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
    fallback = _without_guesses(rig, make)
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
    source = motion_kinds(rig)[0]
    return source.explained(rig, recordings, lambda changed: _converged_attempt(changed, make) is not None) or failed


def _make_attempt(
    rig: Rig,
    recordings: Sequence[Measurements],
    lap: Callable[[str], None],
    on_step: Callable[[str, Step], None],
    on_visit: OnVisit,
) -> Attempt:
    """Initial guess and estimate of one rig. Raises EstimationError."""
    inputs, state, guess = guess_of_rig(rig, recordings, lap)
    trim_heap()
    with ExitStack() as explaining:
        for kind in kinds_of(rig):
            explaining.enter_context(kind.explaining(inputs))
        solution = determine(inputs, state, guess, Callbacks(on_step, partial(on_visit, inputs)))
    return Attempt(inputs, solution)


def _without_guesses(rig: Rig, make: Callable[[Rig], Attempt]) -> Attempt | None:
    """The estimate without guesses. If parameters are unobservable then, guesses that agree with it are used after all.
    None if the rig has no guesses, or the estimate fails."""
    fallback = _without_values(rig, make, lambda p: p.mode == "free") if _has_values(rig, "free") else None
    if fallback is None:
        return None
    values = fallback.solution.estimate.outcome.state.values

    def agreeing(sensor: Sensor, name: str, p: Parameter) -> Parameter:
        if p.mode != "free" or p.value is None or name == "time_offset":
            return Parameter() if p.mode == "free" else p
        estimate = values.get((sensor.name, name), p.value)
        return Parameter() if is_contradicted(sensor.spec(name), p.value, estimate) else p

    agreeing_rig = with_groups(rig, agreeing)
    if (
        fallback.solution.fixed_directions.size
        and _has_values(agreeing_rig, "free")
        and (refined := _converged_attempt(agreeing_rig, make)) is not None
    ):
        fallback = refined
    return replace(fallback, inputs=replace(fallback.inputs, user_rig=rig))


def _without_values(rig: Rig, make: Callable[[Rig], Attempt], dropped: Callable[[Parameter], bool]) -> Attempt | None:
    """The estimate without the values that `dropped` selects. If it fails, and cameras have feature tracks only, their
    intrinsics are kept as guesses, because not every motion makes them observable. None if it fails again."""

    def bare(lens: bool) -> Rig:
        return with_groups(
            rig,
            lambda sensor, name, p: (
                p if not dropped(p) else Parameter("free", p.value if lens and name in LENS else None)
            ),
        )

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
    """Whether the rig file gives a value with this mode."""
    return any(p.mode == mode and p.value is not None for _, _, p in groups_of(rig))


def _converged_attempt(rig: Rig, make: Callable[[Rig], Attempt]) -> Attempt | None:
    """The attempt if it converges, else None."""
    try:
        result = make(rig)
    except EstimationError:
        return None
    return result if result.converged else None
