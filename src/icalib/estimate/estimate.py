"""The reweighting loop: solve, estimate noise and inliers from the residuals, freeze them, solve again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from icalib.estimate.problem.assembly import assemble, keyframe_times, keyframes_for, resample
from icalib.estimate.problem.guess_priors import guess_priors
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.problem.outcome import Outcome, Step, Visit, relative_decrease
from icalib.estimate.problem.problem import Problem
from icalib.estimate.problem.solver import minimise
from icalib.estimate.residual_statistics.fit_statistics import chi2_by_kind, fits
from icalib.model.sensor_model import by_kind
from icalib.model.statistics import PassEnd
from icalib.optim import memory
from icalib.optim.calib_block import NO_DIRECTIONS
from icalib.optim.prior_factor import Prior, without_priors
from icalib.optim.state import State

FIRST_PASS_PRIOR_WIDTH = 3.0  # width of the priors of `first_pass`, over the prior uncertainty of the guess
# An early pass stops if the predicted decrease of half the chi^2 is below the first, or below the second times it.
EARLY_DECREASE, EARLY_DECREASE_SHARE = 0.5, 1e-6
FIRST_DECREASE_SHARE = 1e-3  # EARLY_DECREASE_SHARE of the first pass, whose noise and inliers are less accurate
MAX_FINAL_REPEATS = 4  # repetitions of the final pass with weights frozen anew
# chi^2 at the start of a pass over chi^2 at its end: above this ratio the weights frozen at the start are out of date
STALE_CHI2_RATIO = 1.1
# relative cost decrease over that of the pass before: above this ratio passes alternate between two states
ALTERNATING_RATIO = 0.5


OnVisit = Callable[[str, Problem, Visit], None]  # called with the name of the pass, its problem, and the solver's visit


@dataclass(frozen=True)
class MeasurementModel:
    """Noise and inliers of one pass. noise: by sensor name, of the noise class of the sensor's kind. coarse: True
    before any residuals are known; the pass is then less accurate and cheaper, see `Pass`."""

    noise: Mapping[str, Any]
    coarse: bool = False

    @classmethod
    def first(cls, inputs: Inputs) -> MeasurementModel:
        """Model before any pass: noise as the rig file states it, else usual values."""
        noise = {}
        for model, sensors in by_kind(inputs.rig.mounted):
            noise |= model.first_noises(sensors, inputs.rig, inputs.measurements)
        return cls(noise, True)

    def problem(self, inputs: Inputs, state: State, fixed_directions: np.ndarray = NO_DIRECTIONS) -> Problem:
        """Problem at `state`; fixed_directions (B, m) as in `assemble`."""
        return assemble(inputs, state, self.noise, fixed_directions, self.coarse)

    def next(self, inputs: Inputs, outcome: Outcome, first: bool) -> MeasurementModel:
        """Model for the next pass, from the residuals of `outcome`. first: whether that pass was the first."""
        problem, residuals = outcome.problem, outcome.residuals
        end = PassEnd(
            inputs.rig, outcome.state, problem.factors, residuals, first, inputs.imu is None,
            cache(lambda: chi2_by_kind(problem, residuals)), cache(lambda: fits(problem, outcome)),
        )  # fmt: skip
        noise = {}
        for model, sensors in by_kind(inputs.rig.mounted):
            noise |= model.next_noises(sensors, self.noise, end)
        return MeasurementModel(noise)


@dataclass(frozen=True)
class Estimate:
    """Result of the last pass. judged: noise and inliers that the pass used. steps: of all passes, each with the name
    of its pass."""

    outcome: Outcome
    judged: MeasurementModel
    steps: tuple[tuple[str, Step], ...]  # of all passes, with the pass's name

    @property
    def problem(self) -> Problem:
        return self.outcome.problem


def estimate(
    inputs: Inputs,
    state: State,
    on_step: Callable[[str, Step], None] = lambda *_: None,
    fixed_directions: np.ndarray = NO_DIRECTIONS,
    on_visit: OnVisit = lambda *_: None,
    judged: MeasurementModel | None = None,
    maybe_rank_deficient: Callable[[Problem, np.ndarray], bool] = lambda *_: False,
    guess: State | None = None,
) -> Estimate:
    """Runs all passes from an initial `state`, and returns the last one. With known noise and inliers `judged`, runs
    the final pass alone.

    fixed_directions (B, m): directions of the calibration parameters that are fixed, see `Problem`. on_step, on_visit:
    called with each step and each `Visit` of the solver. maybe_rank_deficient: gets a problem and the information (B,
    B) of the calibration parameters. If it returns True, the pass stops early, because it would converge slowly along
    an unobservable direction. guess: mean of priors that keep unobservable directions from drifting. They apply until
    the null space is known, and while directions are fixed. A pass that ends with these priors counts as stopped early,
    too.

    Raises EstimationError if the data do not suffice for an estimate.
    """
    *early, final = pass_names(inputs)
    about = () if guess is None else guess_priors(inputs, guess)
    passes = _Passes(
        inputs,
        fixed_directions,
        on_step,
        on_visit,
        maybe_rank_deficient,
        state,
        judged or MeasurementModel.first(inputs),
        about,
    )
    if judged is None:
        for name in early:
            passes.early(name)
            memory.trim_heap()  # before the next one takes as much memory
    else:
        passes.begin_at(state)
    way = np.inf
    for left in reversed(range(1 + MAX_FINAL_REPEATS)):
        way_before = way if left else 0.0  # 0: the last repetition runs to convergence, see `_is_far`
        outcome, way = passes.final(final, way_before)
        if not left or not _again(inputs, outcome, passes.judged, way, way_before):
            return Estimate(_without_priors(outcome, passes.about), passes.judged, tuple(passes.history))
        passes.begin_at(outcome.state)
        del outcome
        memory.trim_heap()
    raise AssertionError("the loop ends where nothing is left")


@dataclass
class _Passes:
    """Passes of one estimate. state: start of the next pass. judged: its noise and inliers. about: priors about the
    initial guess, in use until every direction is observable and none is fixed."""

    inputs: Inputs
    fixed_directions: np.ndarray
    on_step: Callable[[str, Step], None]
    on_visit: OnVisit
    maybe_rank_deficient: Callable[[Problem, np.ndarray], bool]
    state: State
    judged: MeasurementModel
    about: tuple[Prior, ...]
    history: list[tuple[str, Step]] = field(default_factory=list)

    def begin_at(self, state: State) -> None:
        """Lets the next pass start at `state`, resampled at the keyframe times that its time offsets imply."""
        self.state = _on_own_keyframes(self.inputs, state)

    def early(self, name: str) -> None:
        """Runs a pass with a wide tolerance, and updates noise and inliers from its residuals."""
        first = name == "first"
        problem, told = self._next(name)
        share = FIRST_DECREASE_SHARE if first else EARLY_DECREASE_SHARE

        def leaves(_: float, information: np.ndarray) -> bool:
            return self.maybe_rank_deficient(problem, information)

        outcome = minimise(problem, self.state, told.step, EARLY_DECREASE, told.visit, share, leaves=leaves)
        self._let_go(self.maybe_rank_deficient(problem, told.information))
        self.judged = self.judged.next(self.inputs, outcome, first)
        self.begin_at(outcome.state)

    def final(self, name: str, way_before: float) -> tuple[Outcome, float]:
        """Solves the final pass. Returns the outcome and its relative cost decrease; `inf` if it stopped early because
        the problem is rank deficient.

        way_before: relative cost decrease of the previous final pass. The pass also stops early if its frozen weights
        are out of date, or while priors about the guess apply. Once every direction is observable, it drops these
        priors and continues.
        """
        problem, told = self._next(name)

        def leaves(way: float, information: np.ndarray) -> bool:
            return bool(self.about) or self.maybe_rank_deficient(problem, information) or _is_far(way, way_before)

        def priors_to_drop(way: float, information: np.ndarray) -> tuple[Prior, ...]:
            return () if _is_far(way, way_before) else self._let_go(self.maybe_rank_deficient(problem, information))

        outcome = minimise(
            problem, self.state, told.step, on_visit=told.visit, leaves=leaves, priors_to_drop=priors_to_drop
        )
        is_open = self.maybe_rank_deficient(problem, told.information)
        way, gone = relative_decrease(outcome.steps, outcome.cost), self._let_go(is_open)
        if gone and not _is_far(way, way_before):
            without, room = outcome.problem.without(gone), outcome.room
            rest = minimise(without, outcome.state, told.step, on_visit=told.visit, room=room)
            outcome = replace(rest, steps=(*outcome.steps, *rest.steps))
            way = relative_decrease(outcome.steps, outcome.cost)
        return outcome, np.inf if is_open and outcome.stopped_early else way

    def _next(self, name: str) -> tuple[Problem, _Told]:
        """Problem of the next pass with the priors about the guess, and the recorder of its steps."""
        problem = _with_priors(self.judged.problem(self.inputs, self.state, self.fixed_directions), self.about)
        return problem, _Told(name, problem, self.on_step, self.on_visit, self.history)

    def _let_go(self, is_open: bool) -> tuple[Prior, ...]:
        """Drops the priors about the guess, unless directions are unobservable (`is_open`) or fixed. Returns the
        dropped priors."""
        if is_open or self.fixed_directions.size:
            return ()
        gone, self.about = self.about, ()
        return gone


@dataclass
class _Told:
    """Recorder of one pass. Appends steps to the `history` of all passes, calls the callbacks, and keeps the latest
    information (B, B) of the calibration parameters."""

    name: str
    problem: Problem
    on_step: Callable[[str, Step], None]
    on_visit: OnVisit
    history: list[tuple[str, Step]]
    information: np.ndarray = field(default_factory=lambda: NO_DIRECTIONS)

    def step(self, step: Step) -> None:
        self.history.append((self.name, step))
        self.on_step(self.name, step)

    def visit(self, at: Visit) -> None:
        self.information = at.information
        self.on_visit(self.name, self.problem, at)


def _with_priors(problem: Problem, more: Sequence[Prior]) -> Problem:
    return replace(problem, priors=(*problem.priors, *more))


def _without_priors(outcome: Outcome, more: Sequence[Prior]) -> Outcome:
    """The outcome of a problem with the priors `more`, as one of the problem without them. If it had converged it
    counts as stopped early, because the optimum without priors differs."""
    if not more:
        return outcome
    return replace(
        outcome,
        problem=outcome.problem.without(more),
        information=without_priors(outcome.information, more, outcome.state),
        stopped_early=outcome.stopped_early or outcome.converged,
    )


def _again(inputs: Inputs, outcome: Outcome, judged: MeasurementModel, way: float, way_before: float) -> bool:
    """True if the final pass must be repeated: its frozen quantities, such as weights of points on planes, are out of
    date, or many rejected measurements fit again.

    way, way_before: relative cost decrease of the last pass and of the pass before. `way` is infinite if the pass
    stopped early because the problem is rank deficient.
    """
    rebuilt = cache(lambda: judged.problem(inputs, _on_own_keyframes(inputs, outcome.state)).factors)
    used = outcome.problem.factors
    return _is_far(way, way_before) or any(m.uses_more(used, rebuilt) for m, _ in by_kind(inputs.sensors))


def _is_far(way: float, way_before: float) -> bool:
    """True if the frozen weights of a pass are out of date, and passes converge instead of alternating between two
    states."""
    return STALE_CHI2_RATIO - 1.0 < way < ALTERNATING_RATIO * way_before


def _on_own_keyframes(inputs: Inputs, state: State) -> State:
    """The same motion, resampled at the keyframe times that its time offsets imply."""
    return resample(state, keyframes_for(inputs, keyframe_times(inputs, state.values)), inputs)


def first_pass(inputs: Inputs, state: State) -> State:
    """State after a first pass over all measurements from `state`, before outliers are rejected. Priors about `state`,
    FIRST_PASS_PRIOR_WIDTH times as wide as the prior uncertainty, keep unobservable directions from drifting.

    Raises EstimationError if the data do not suffice for an estimate.
    """
    problem = MeasurementModel.first(inputs).problem(inputs, state)
    problem = _with_priors(problem, guess_priors(inputs, state, FIRST_PASS_PRIOR_WIDTH))
    return minimise(problem, state, tolerance=EARLY_DECREASE, share=EARLY_DECREASE_SHARE, second_order=False).state


def pass_names(inputs: Inputs) -> tuple[str, ...]:
    """Names of the passes in order. Between the first and the final pass there are up to two that estimate noise and
    inliers, as many as the sensors need."""
    count = max((m.passes(own, inputs.rig, inputs.measurements) for m, own in by_kind(inputs.sensors)), default=0)
    return ("first", *("noise", "noise again")[:count], "final")
