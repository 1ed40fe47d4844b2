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

FIRST_PASS_PRIOR_WIDTH = 3.0  # times the prior uncertainty of the initial guess
# An early pass stops where the next step would lower half the chi^2 by less, or by less than that share of it.
EARLY_DECREASE, EARLY_DECREASE_SHARE = 0.5, 1e-6
FIRST_DECREASE_SHARE = 1e-3  # the same of the first pass: noise and inliers that it freezes are farther off
MAX_FINAL_REPEATS = 4  # of the final pass
# ratio of the chi^2 at the start of a pass to that at its end, above which frozen weights are out of date
STALE_CHI2_RATIO = 1.1
# relative cost decrease over that of the pass before: above it passes alternate between two states
ALTERNATING_RATIO = 0.5


OnVisit = Callable[[str, Problem, Visit], None]  # told of the pass's name, its problem, and where the solver stood


@dataclass(frozen=True)
class MeasurementModel:
    """Noise and inliers of a pass. noise: by sensor, of the class that its kind has. coarse: nothing is known yet, so
    the pass costs little, see `Pass`."""

    noise: Mapping[str, Any]
    coarse: bool = False

    @classmethod
    def first(cls, inputs: Inputs) -> MeasurementModel:
        """Before any pass: what the rig file says, or what is usual, of all there is."""
        noise = {}
        for model, sensors in by_kind(inputs.rig.mounted):
            noise |= model.first_noises(sensors, inputs.rig, inputs.measurements)
        return cls(noise, True)

    def problem(self, inputs: Inputs, state: State, fixed_directions: np.ndarray = NO_DIRECTIONS) -> Problem:
        """See `assemble`."""
        return assemble(inputs, state, self.noise, fixed_directions, self.coarse)

    def next(self, inputs: Inputs, outcome: Outcome, first: bool) -> MeasurementModel:
        """As what a pass left behind, the `first` or another, shows it."""
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
    """The last pass: where the solver ended, and what it was told of the noise."""

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
    """All passes from an initial `state`; the final one alone if noise and outliers are `judged` already.

    Directions of the calibration parameters in `fixed_directions` (see Problem) are fixed. A pass stops early if the
    information of the calibration parameters (B, B) may be rank deficient, as `maybe_rank_deficient` tells, because it
    would converge slowly along an unobservable direction. Until the null space is known, and while directions are
    fixed, `guess` is a prior, so that unobservable directions do not drift. A pass that ended with that prior counts as
    stopped early, too.

    Raises EstimationError where the data do not carry an estimate.
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
        way_before = way if left else 0.0  # nearer than that is not to be had any more
        outcome, way = passes.final(final, way_before)
        if not left or not _again(inputs, outcome, passes.judged, way, way_before):
            return Estimate(_without_priors(outcome, passes.about), passes.judged, tuple(passes.history))
        passes.begin_at(outcome.state)
        del outcome
        memory.trim_heap()
    raise AssertionError("the loop ends where nothing is left")


@dataclass
class _Passes:
    """Passes of one estimate. The next one begins at `state`, with the measurement model `judged` so far. Priors
    `about` the guess apply until every direction is observable and none is fixed."""

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
        """The next pass: of the same motion, at the keyframes that its clocks want."""
        self.state = _on_own_keyframes(self.inputs, state)

    def early(self, name: str) -> None:
        """One that leads near, and shows what is judged before the next."""
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
        """Solve the final pass. Returns the outcome and its relative cost decrease; `inf` if it stopped early because
        the problem is rank deficient. The pass may also stop early to freeze its choices anew, or to drop priors."""
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
        problem = _with_priors(self.judged.problem(self.inputs, self.state, self.fixed_directions), self.about)
        return problem, _Told(name, problem, self.on_step, self.on_visit, self.history)

    def _let_go(self, is_open: bool) -> tuple[Prior, ...]:
        """Priors that count no more."""
        if is_open or self.fixed_directions.size:
            return ()
        gone, self.about = self.about, ()
        return gone


@dataclass
class _Told:
    """Passes on what a pass tells of its way, keeps the steps in a `history` of all passes, and the calibration
    parameters' last information (B, B)."""

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
    """The outcome of a problem with `more` priors as one of the problem without, of which it is no more than half-way
    to the end."""
    if not more:
        return outcome
    return replace(
        outcome,
        problem=outcome.problem.without(more),
        information=without_priors(outcome.information, more, outcome.state),
        stopped_early=outcome.stopped_early or outcome.converged,
    )


def _again(inputs: Inputs, outcome: Outcome, judged: MeasurementModel, way: float, way_before: float) -> bool:
    """Whether the last pass is to be made anew: what it froze, such as the weights of points on planes, is of a state
    far from its end, but nearer than in the last pass before, or many measurements fit again that it rejected. way:
    relative cost decrease, infinite if the pass stopped early because the problem is rank deficient."""
    rebuilt = cache(lambda: judged.problem(inputs, _on_own_keyframes(inputs, outcome.state)).factors)
    used = outcome.problem.factors
    return _is_far(way, way_before) or any(m.uses_more(used, rebuilt) for m, _ in by_kind(inputs.sensors))


def _is_far(way: float, way_before: float) -> bool:
    return STALE_CHI2_RATIO - 1.0 < way < ALTERNATING_RATIO * way_before


def _on_own_keyframes(inputs: Inputs, state: State) -> State:
    """The same motion, at the keyframes that its clocks want."""
    return resample(state, keyframes_for(inputs, keyframe_times(inputs, state.values)), inputs)


def first_pass(inputs: Inputs, state: State) -> State:
    """The state after a first pass over all measurements from `state`, before outliers are rejected. Priors of a few
    times the prior uncertainty keep the calibration near its guess, so that unobservable directions do not drift.

    Raises EstimationError where the data do not carry an estimate.
    """
    problem = MeasurementModel.first(inputs).problem(inputs, state)
    problem = _with_priors(problem, guess_priors(inputs, state, FIRST_PASS_PRIOR_WIDTH))
    return minimise(problem, state, tolerance=EARLY_DECREASE, share=EARLY_DECREASE_SHARE, second_order=False).state


def pass_names(inputs: Inputs) -> tuple[str, ...]:
    """The passes: keyframes and assignment are made anew once; estimates of noise and inliers take more."""
    count = max((m.passes(own, inputs.rig, inputs.measurements) for m, own in by_kind(inputs.sensors)), default=0)
    return ("first", *("noise", "noise again")[:count], "final")
