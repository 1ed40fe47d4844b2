"""The reweighting loop: solve, estimate noise and inliers from the residuals, freeze them, solve again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np

from icalib.estimate.inputs import Inputs
from icalib.estimate.problem import (
    Problem,
    assemble,
    begun,
    guess_priors,
    keyframe_times,
    keyframes_for,
    resample,
)
from icalib.estimate.residual_statistics import chi2_by_kind, fits
from icalib.estimate.solver import Outcome, SolverOptions, Step, Visit, minimise, relative_decrease
from icalib.model.sensor_model import PassEnd, by_kind
from icalib.optim import memory
from icalib.optim.arrowhead import NO_DIRECTIONS, Prior, without_priors
from icalib.optim.state import State

FIRST_PASS_PRIOR_WIDTH = 3.0  # width of the priors of `first_pass`, over the prior uncertainty of the guess
# An early pass stops if the predicted decrease of half the chi^2 is below the first, or below the second times it.
EARLY_DECREASE, EARLY_DECREASE_SHARE = 0.5, 1e-6
EARLY_PASS = SolverOptions(tolerance=EARLY_DECREASE, tolerance_share=EARLY_DECREASE_SHARE)
FIRST_DECREASE_SHARE = 1e-3  # EARLY_DECREASE_SHARE of the first pass, whose noise and inliers are less accurate
MAX_FINAL_REPEATS = 4  # repetitions of the final pass with weights frozen anew
# chi^2 at the start of a pass over chi^2 at its end: above this ratio the weights frozen at the start are out of date
STALE_CHI2_RATIO = 1.1
# relative cost decrease over that of the pass before: above this ratio passes alternate between two states
ALTERNATING_RATIO = 0.5


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
            noise |= model.first_noise(sensors, inputs.rig, inputs.measurements)
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
            noise |= model.next_noise(sensors, self.noise, end)
        return MeasurementModel(noise)


@dataclass(frozen=True)
class Estimate:
    """Result of the last pass. measurement_model: noise and inliers that the pass used. steps: of all passes, each with
    the name of its pass."""

    outcome: Outcome
    measurement_model: MeasurementModel
    steps: tuple[tuple[str, Step], ...]

    @property
    def problem(self) -> Problem:
        return self.outcome.problem


OnVisit = Callable[[str, Problem, Visit], None]


@dataclass(frozen=True)
class Callbacks:
    """Functions that observe the solver. on_step: called with the name of the pass and each step. on_visit: called with
    the name of the pass, its problem, and each state at which a step is computed."""

    on_step: Callable[[str, Step], None] = lambda *_: None
    on_visit: OnVisit = lambda *_: None


@dataclass(frozen=True)
class EstimateOptions:
    """Options of `estimate`.

    fixed_directions (B, m): directions of the calibration parameters that are fixed, see `Problem`.

    measurement_model: known noise and inliers. With them only the final pass runs.

    guess: mean of priors that keep unobservable directions from drifting. They apply until the null space is known, and
    while directions are fixed. A pass that ends with these priors counts as stopped early.

    maybe_rank_deficient: gets a problem and the information (B, B) of the calibration parameters. If it returns True,
    the pass stops early, because it would converge slowly along an unobservable direction.
    """

    fixed_directions: np.ndarray = field(default_factory=lambda: NO_DIRECTIONS)
    measurement_model: MeasurementModel | None = None
    guess: State | None = None
    maybe_rank_deficient: Callable[[Problem, np.ndarray], bool] = lambda *_: False


NO_CALLBACKS, DEFAULT_OPTIONS = Callbacks(), EstimateOptions()


def estimate(
    inputs: Inputs,
    state: State,
    options: EstimateOptions = DEFAULT_OPTIONS,
    callbacks: Callbacks = NO_CALLBACKS,
) -> Estimate:
    """Runs all passes from an initial `state`, and returns the last one. Raises EstimationError if the data do not
    suffice for an estimate."""
    passes = _Passes.begin(inputs, state, options, callbacks)
    *early_names, final_name = pass_names(inputs)
    if options.measurement_model is not None:
        passes.begin_at(state)
        return passes.run_final(final_name)
    for name in early_names:
        passes.run_early(name)
        memory.trim_heap()  # before the next one takes as much memory
    return passes.run_final(final_name)


@dataclass
class _Passes:
    """Passes of one estimate. state: start of the next pass. measurement_model: its noise and inliers. guess_priors:
    priors about the initial guess, in use until every direction is observable and none is fixed. history: steps of all
    passes."""

    inputs: Inputs
    options: EstimateOptions
    callbacks: Callbacks
    state: State
    measurement_model: MeasurementModel
    guess_priors: tuple[Prior, ...]
    history: list[tuple[str, Step]] = field(default_factory=list)

    @classmethod
    def begin(cls, inputs: Inputs, state: State, options: EstimateOptions, callbacks: Callbacks) -> _Passes:
        """Passes before the first one, which starts at `state`."""
        priors = () if options.guess is None else guess_priors(inputs, options.guess)
        measurement_model = options.measurement_model or MeasurementModel.first(inputs)
        return cls(inputs, options, callbacks, begun(inputs, state), measurement_model, priors)

    def begin_at(self, state: State) -> None:
        """Lets the next pass start at `state`, resampled at the keyframe times that its time offsets imply."""
        self.state = _resampled(self.inputs, state)

    def run_early(self, name: str) -> None:
        """Runs a pass with a wide tolerance, and updates noise and inliers from its residuals."""
        first = name == "first"
        problem, recorder = self._next(name)
        options = SolverOptions(
            tolerance=EARLY_DECREASE,
            tolerance_share=FIRST_DECREASE_SHARE if first else EARLY_DECREASE_SHARE,
            stops_early=lambda _, information: self.options.maybe_rank_deficient(problem, information),
            on_step=recorder.step,
            on_visit=recorder.visit,
        )
        outcome = minimise(problem, self.state, options)
        self._drop_guess_priors(self.options.maybe_rank_deficient(problem, recorder.information))
        self.measurement_model = self.measurement_model.next(self.inputs, outcome, first)
        self.begin_at(outcome.state)

    def run_final(self, name: str) -> Estimate:
        """Runs the final pass, and repeats it while its frozen quantities are out of date."""
        decrease = np.inf
        for n_left in reversed(range(1 + MAX_FINAL_REPEATS)):
            decrease_before = decrease if n_left else 0.0  # 0: the last one runs to convergence, see `_is_stale`
            outcome, decrease = self._final(name, decrease_before)
            if not n_left or not self._must_repeat(outcome, decrease, decrease_before):
                return Estimate(
                    _without_priors(outcome, self.guess_priors), self.measurement_model, tuple(self.history)
                )
            self.begin_at(outcome.state)
            del outcome
            memory.trim_heap()
        raise AssertionError("the last repetition returns")

    def _final(self, name: str, decrease_before: float) -> tuple[Outcome, float]:
        """Solves the final pass. Returns the outcome and its relative cost decrease; `inf` if it stopped early because
        the problem is rank deficient.

        decrease_before: relative cost decrease of the previous final pass. The pass also stops early if its frozen
        weights are out of date, or while priors about the guess apply. Once every direction is observable, it drops
        these priors and continues.
        """
        problem, recorder = self._next(name)
        maybe_rank_deficient = partial(self.options.maybe_rank_deficient, problem)

        def stops_early(decrease: float, information: np.ndarray) -> bool:
            return bool(self.guess_priors) or maybe_rank_deficient(information) or _is_stale(decrease, decrease_before)

        def priors_to_drop(decrease: float, information: np.ndarray) -> tuple[Prior, ...]:
            if _is_stale(decrease, decrease_before):
                return ()
            return self._drop_guess_priors(maybe_rank_deficient(information))

        to_convergence = SolverOptions(on_step=recorder.step, on_visit=recorder.visit)
        options = replace(to_convergence, stops_early=stops_early, priors_to_drop=priors_to_drop)
        outcome = minimise(problem, self.state, options)
        is_deficient = maybe_rank_deficient(recorder.information)
        decrease, dropped = relative_decrease(outcome.steps, outcome.cost), self._drop_guess_priors(is_deficient)
        if dropped and not _is_stale(decrease, decrease_before):
            outcome = _continued(outcome, dropped, to_convergence)
            decrease = relative_decrease(outcome.steps, outcome.cost)
        return outcome, np.inf if is_deficient and outcome.stopped_early else decrease

    def _next(self, name: str) -> tuple[Problem, _PassRecorder]:
        """Problem of the next pass with the priors about the guess, and the recorder of its steps."""
        problem = self.measurement_model.problem(self.inputs, self.state, self.options.fixed_directions)
        problem = _with_priors(problem, self.guess_priors)
        return problem, _PassRecorder(name, problem, self.callbacks, self.history)

    def _drop_guess_priors(self, is_deficient: bool) -> tuple[Prior, ...]:
        """Drops the priors about the guess, unless directions are unobservable (`is_deficient`) or fixed. Returns the
        dropped priors."""
        if is_deficient or self.options.fixed_directions.size:
            return ()
        dropped, self.guess_priors = self.guess_priors, ()
        return dropped

    def _must_repeat(self, outcome: Outcome, decrease: float, decrease_before: float) -> bool:
        """True if the final pass must be repeated: its frozen quantities, such as weights of points on planes, are out
        of date, or many rejected measurements fit again.

        decrease, decrease_before: relative cost decrease of the last pass and of the pass before. `decrease` is
        infinite if the pass stopped early because the problem is rank deficient.
        """
        inputs, model = self.inputs, self.measurement_model
        rebuilt = cache(lambda: model.problem(inputs, _resampled(inputs, outcome.state)).factors)
        used = outcome.problem.factors
        return _is_stale(decrease, decrease_before) or any(
            m.uses_more(used, rebuilt) for m, _ in by_kind(inputs.sensors)
        )


@dataclass
class _PassRecorder:
    """Recorder of one pass. Appends steps to the `history` of all passes, calls the callbacks, and keeps the latest
    information (B, B) of the calibration parameters."""

    name: str
    problem: Problem
    callbacks: Callbacks
    history: list[tuple[str, Step]]
    information: np.ndarray = field(default_factory=lambda: NO_DIRECTIONS)

    def step(self, step: Step) -> None:
        self.history.append((self.name, step))
        self.callbacks.on_step(self.name, step)

    def visit(self, visit: Visit) -> None:
        self.information = visit.information
        self.callbacks.on_visit(self.name, self.problem, visit)


def _continued(outcome: Outcome, dropped: Sequence[Prior], options: SolverOptions) -> Outcome:
    """The pass of `outcome`, continued without the priors `dropped`, with the steps of both parts."""
    problem, workspace = outcome.problem.without(dropped), outcome.workspace
    end = minimise(problem, outcome.state, options, workspace)
    return replace(end, steps=(*outcome.steps, *end.steps))


def _with_priors(problem: Problem, priors: Sequence[Prior]) -> Problem:
    return replace(problem, priors=(*problem.priors, *priors))


def _without_priors(outcome: Outcome, priors: Sequence[Prior]) -> Outcome:
    """The outcome of a problem with `priors`, as one of the problem without them. If it had converged it counts as
    stopped early, because the optimum without priors differs."""
    if not priors:
        return outcome
    return replace(
        outcome,
        problem=outcome.problem.without(priors),
        information=without_priors(outcome.information, priors, outcome.state),
        stopped_early=outcome.stopped_early or outcome.converged,
    )


def _is_stale(decrease: float, decrease_before: float) -> bool:
    """True if the frozen weights of a pass are out of date, and passes converge instead of alternating between two
    states. decrease, decrease_before: relative cost decrease of the pass, and of the one before."""
    return STALE_CHI2_RATIO - 1.0 < decrease < ALTERNATING_RATIO * decrease_before


def _resampled(inputs: Inputs, state: State) -> State:
    """The same motion, resampled at the keyframe times that its time offsets imply."""
    return resample(state, keyframes_for(inputs, keyframe_times(inputs, state.values)), inputs)


def first_pass(inputs: Inputs, state: State) -> State:
    """State after a first pass over all measurements from `state`, before outliers are rejected. Priors about `state`,
    FIRST_PASS_PRIOR_WIDTH times as wide as the prior uncertainty, keep unobservable directions from drifting.

    Raises EstimationError if the data do not suffice for an estimate.
    """
    state = begun(inputs, state)
    problem = MeasurementModel.first(inputs).problem(inputs, state)
    problem = _with_priors(problem, guess_priors(inputs, state, FIRST_PASS_PRIOR_WIDTH))
    return minimise(problem, state, replace(EARLY_PASS, second_order=False)).state


def pass_names(inputs: Inputs) -> tuple[str, ...]:
    """Names of the passes in order. Between the first and the final pass there are up to two that estimate noise and
    inliers, as many as the sensors need."""
    kinds = by_kind(inputs.sensors)
    of = inputs.rig, inputs.measurements, inputs.association
    count = max((model.passes(sensors, *of) for model, sensors in kinds), default=0)
    return ("first", *("noise", "noise again")[:count], "final")
