"""Levenberg-Marquardt on the manifold: options, damping, the loop over steps, its outcome."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.problem import Problem
from icalib.motion.factor import Residuals
from icalib.optim.anderson import MIN_ACCELERATED_GAIN, Accelerator
from icalib.optim.arrowhead import (
    DETERMINED_ABOVE,
    NO_DIRECTIONS,
    Draw,
    NotDefiniteError,
    Piece,
    Prior,
    Solution,
    essential_information,
    sums_of_priors,
)
from icalib.optim.state import State

# Options of the solver: when it ends, when it stops early, and what it reports.

# A decrease of half the chi^2 by 5e-4 is a step of at most 0.03 standard deviations, in any direction.
CONVERGED_DECREASE = 5e-4
ROUNDING_SHARE = 1e-11  # of the cost: rounding error of a sum of 1e6 squares


@dataclass(frozen=True)
class SolverOptions:
    """Options of `minimise`.

    tolerance, tolerance_share: the solver ends when the predicted decrease of half the chi^2 is below `tolerance`, or
    below `tolerance_share` of half the chi^2. A tolerance above STALLED_DECREASE means that another pass follows: the
    outcome has no information and no draws.

    second_order: whether steps that raise the cost are corrected, see `Descent._second_order_correction`.

    stops_early: whether to stop before convergence, given the relative cost decrease so far and the information (B, B)
    of the calibration parameters. It is called when the predicted decrease is low or convergence is slow.
    priors_to_drop: priors to drop from the problem, given the same; called first.

    on_step, on_visit: called with each step, and with each state at which a step is computed.
    """

    tolerance: float = CONVERGED_DECREASE
    tolerance_share: float = ROUNDING_SHARE
    second_order: bool = True
    stops_early: Callable[[float, np.ndarray], bool] = lambda *_: False
    priors_to_drop: Callable[[float, np.ndarray], Sequence[Prior]] = lambda *_: ()
    on_step: Callable[[Step], None] = lambda _: None
    on_visit: Callable[[Visit], None] = lambda _: None


DEFAULT_OPTIONS = SolverOptions()


MAX_ITERATIONS = 50
EARLY_STOP_DECREASE = 0.5  # of half the chi^2: below this predicted decrease, the solver may stop early


def minimise(
    problem: Problem,
    state: State,
    options: SolverOptions = DEFAULT_OPTIONS,
    workspace: tuple[Piece, ...] | None = None,
) -> Outcome:
    """Minimises `problem` from `state` until the predicted decrease of half the chi^2 is negligible, see
    `SolverOptions`.

    workspace: pieces of an outcome with the same features, which are overwritten. Raises EstimationError if no step can
    be computed at all.
    """
    descent = Descent.begin(problem, state, options, workspace)
    for _ in range(MAX_ITERATIONS):
        solution = descent.solution()
        options.on_visit(Visit(descent.state, solution.information))
        solution = _without_dropped_priors(descent, solution)
        early_stop = _early_stop(descent, solution)
        if early_stop == "now":
            outcome = descent.outcome(solution) if descent.is_undamped else descent.end()
            return replace(outcome, stopped_early=True)
        if (outcome := descent.final_outcome(solution)) is not None:
            return outcome
        accepted, converged = descent.step(solution)
        if converged:
            break
        if accepted:
            continue
        if early_stop == "if the step fails":
            return replace(descent.end(), stopped_early=True)
        if not descent.raise_damping(solution):
            break
    return descent.end()


def _without_dropped_priors(descent: Descent, solution: Solution) -> Solution:
    """The solution after `SolverOptions.priors_to_drop` are dropped. It is called if the predicted decrease is below
    EARLY_STOP_DECREASE."""
    if not (descent.is_undamped and solution.decrease < EARLY_STOP_DECREASE):
        return solution
    priors = descent.options.priors_to_drop(relative_decrease(descent.steps, descent.cost), solution.information)
    return descent.drop_priors(priors, solution) if priors else solution


def _early_stop(descent: Descent, solution: Solution) -> Literal["no", "now", "if the step fails"]:
    """Whether the solver stops early. `SolverOptions.stops_early` is called if convergence is slow, or if the predicted
    decrease is near EARLY_STOP_DECREASE. Unless it is below, the next step is tried first."""
    is_slow = descent.converges_slowly(solution)
    is_near = descent.is_undamped and solution.decrease < RESTING_RATIO * EARLY_STOP_DECREASE
    if not (is_slow or is_near):
        return "no"
    if not descent.options.stops_early(relative_decrease(descent.steps, descent.cost), solution.information):
        return "no"
    is_low = is_slow or solution.decrease < EARLY_STOP_DECREASE
    return "now" if is_low and (descent.is_undamped or descent.is_early) else "if the step fails"


# Damping of the Levenberg-Marquardt steps, and when they use the true curvature of the robust loss.

CURVED_BELOW_SHARE = 1e-2  # of the cost: steps that predict less use the true curvature of the robust loss
# Nielsen 1999, "Damping parameter in Marquardt's method": smallest reduction factor of damping after a failure
MIN_FACTOR_AFTER_FAILURE = 1.0 / 3.0
MIN_GAIN_RATIO = 0.25  # actual over predicted decrease: below it damping is not reduced


@dataclass(frozen=True)
class DampingSchedule:
    """Damping schedule. least_after_failure: least damping after a failed step. growth: factor after a failure; its
    powers after successive failures. min_factor: smallest reduction factor after successive good steps. zero_below:
    damping below it is set to 0, so that it does not swamp the weak information of a planar drive."""

    least_after_failure: float
    growth: float
    min_factor: float
    zero_below: float


CAREFUL_DAMPING = DampingSchedule(1e-6, 2.0, 0.1, 1e-10)
EARLY_DAMPING = DampingSchedule(1e-4, 8.0, 0.01, 2e-6)  # for a pass that need not converge


@dataclass
class Damping:
    """Damping of the next step, and the curvature of the robust loss in the sums.

    value: factor on the diagonal of the normal equations, 0 for Gauss-Newton steps. curved: whether the sums have the
    true curvature, instead of weights alone. curved_below: share of the cost; steps with a smaller predicted decrease
    use the true curvature. failures: since the last accepted step.
    """

    schedule: DampingSchedule
    value: float = 0.0
    curved: bool = False
    curved_below: float = CURVED_BELOW_SHARE
    failures: int = 0

    def after_success(self, curved: bool, gain: float) -> None:
        """Update after an accepted step. curved: whether its sums have the true curvature. gain: actual over predicted
        decrease. After a failure damping is reduced slowly, because with much less the next step would fail, too."""
        self.curved = curved
        if gain > MIN_GAIN_RATIO:
            least = MIN_FACTOR_AFTER_FAILURE if self.failures else self.schedule.min_factor
            self.value *= max(least, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
        self.failures = 0
        self.value = 0.0 if self.value < self.schedule.zero_below else self.value

    def after_failure(self) -> None:
        """Update after a failed step: first the true curvature is replaced by weights alone, then damping grows."""
        if self.curved:
            self.curved_below *= 0.1
        else:
            self.failures += 1
            self.value = max(self.value * self.schedule.growth**self.failures, self.schedule.least_after_failure)
        self.curved = False


# State of the Levenberg-Marquardt solver, and its steps on the manifold.

MAX_STALLED_STEPS = 4  # failed steps with a predicted decrease below STALLED_DECREASE, before the solver ends
# of the excess cost: second-order correction continues while each of its steps leaves at most this share
MAX_CORRECTION_RATIO = 0.25
MAX_LINEAR_DECREASE = 1e3  # of half the chi^2: largest predicted decrease of a step that can be linear
MAX_LINEAR_MISMATCH = 0.1  # of the tolerance: largest error of the predicted decrease of a linear step
OVERSHOOT_GAIN = 0.5  # actual over predicted decrease: a step with a smaller absolute value overshoots
CORRECTION_DAMPING = 1e-6  # of steps of the second-order correction: they move across a valley, not along it
# Convergence is slow if a step predicts over half of the least of so many before. With 1, any nonlinearity would count.
SLOW_STEPS = 2
RESTING_RATIO = 20.0  # times the tolerance of an early pass: a step that predicts less and fails ends the pass
MIN_DAMPING = 1e-8  # first damping if the undamped normal equations are not positive definite
MAX_SOLVABLE_DAMPING = 1e3  # largest damping with which the normal equations are tried
MAX_DAMPING = 1e6  # after failed steps: beyond it the solver ends
SMALL_DECREASE = 0.5  # of half the chi^2: a step of one standard deviation, all parameters together
NEGLIGIBLE_DECREASE = 2e-5  # of half the chi^2: a step of 0.006 standard deviations: too small to linearise again


@dataclass
class Descent:
    """State of the solver. cost: half the robust chi^2 at `state`; pieces and residuals: filled at `state`. n_stalled:
    number of small steps that failed."""

    problem: Problem
    state: State
    options: SolverOptions
    pieces: tuple[Piece, ...]
    residuals: Residuals
    cost: float
    steps: list[Step] = field(default_factory=list)
    damping: Damping = field(init=False)
    n_stalled: int = 0
    accelerator: Accelerator = field(default_factory=Accelerator)

    def __post_init__(self) -> None:
        self.damping = Damping(EARLY_DAMPING if self.is_early else CAREFUL_DAMPING)

    @classmethod
    def begin(
        cls, problem: Problem, state: State, options: SolverOptions, workspace: tuple[Piece, ...] | None = None
    ) -> Descent:
        """The solver before its first step. workspace: pieces that are overwritten."""
        pieces, residuals = workspace or problem.pieces(), problem.residuals()
        cost = problem.linearise(state, pieces, residuals)
        return cls(problem, state, options, pieces, residuals, cost)

    @property
    def is_early(self) -> bool:
        """Whether another pass follows; then the tolerance is wide."""
        return self.options.tolerance > STALLED_DECREASE

    @property
    def min_decrease(self) -> float:
        """Decrease of half the chi^2 that is too small for a further step."""
        return max(self.options.tolerance, self.options.tolerance_share * self.cost)

    @property
    def is_undamped(self) -> bool:
        """Whether steps are undamped."""
        return self.damping.value == 0.0

    def solution(self) -> Solution:
        """Solves the normal equations. Damping is raised from its present value until they are positive definite.
        Raises EstimationError."""
        if not np.isfinite(self.cost):
            raise EstimationError(
                "the initial guess predicts no finite measurement; give a better guess in the rig file."
            )
        while True:
            try:
                return self._solve(self.damping.value)
            except NotDefiniteError:
                self.damping.value = max(10.0 * self.damping.value, MIN_DAMPING)
                if self.damping.value > MAX_SOLVABLE_DAMPING:
                    raise
                # The failed factorisation has overwritten the sums.
                self._linearise(self.state, curved=self.damping.curved)

    def converges_slowly(self, solution: Solution) -> bool:
        """Whether the predicted decrease is more than half the least of the last undamped steps.

        It shrinks quickly if the measurements determine all parameters, and not along directions that only noise
        determines. Failed and damped steps are not compared, because the next step does not predict less after them.
        """
        predicted = [
            step.predicted_decrease for step in self.steps[-SLOW_STEPS:] if step.accepted and step.damping == 0.0
        ]
        return len(predicted) == SLOW_STEPS and solution.decrease > 0.5 * min(predicted)

    def drop_priors(self, priors: Sequence[Prior], solution: Solution) -> Solution:
        """Drops `priors` from the problem, and returns the solution without them. Their information and gradient on the
        calibration parameters are subtracted, so the chain is not eliminated again."""
        cost, gradient, information = sums_of_priors(priors, self.state, self.problem.layout.size)
        self.problem, self.cost = self.problem.without(priors), self.cost - cost
        return solution.less(information, gradient)

    def final_outcome(self, solution: Solution) -> Outcome | None:
        """The outcome if the step of `solution` would change rounding errors only, or is the last one needed. None if
        more steps are needed."""
        if self._is_rounding(solution):
            self._record(solution, True)
            return self.outcome(solution)
        remaining_decrease = self._final_step(solution)
        if remaining_decrease is None:
            return None
        self.options.on_visit(Visit(self.state, solution.information))
        return self.outcome(solution, remaining_decrease)

    def step(self, solution: Solution) -> tuple[bool, bool]:
        """Tries a step. Returns whether it is accepted, and whether it is the last one."""
        curved = solution.decrease < self.damping.curved_below * self.cost
        if self._accelerated_step(solution, curved):
            return True, False
        full_step = candidate = self.state.retract(self.problem.layout, solution.chain, solution.calib)
        linear_cost = self._linear_step_cost(solution, candidate, curved)
        converged = linear_cost is not None or (self.is_undamped and solution.decrease < self.min_decrease)
        sums = not (converged and self.is_early)
        cost = self._linearise(candidate, sums, curved) if linear_cost is None else linear_cost
        if not (self.is_early or converged):
            candidate, cost = self._line_search(solution, candidate, cost, curved)
        if self.options.second_order and sums and not (cost < self.cost or converged):
            candidate, cost = self._second_order_correction(candidate, cost, curved)
        # At the optimum rounding decides whether the cost falls, so a last step is accepted anyway. If the cost rises
        # by `min_decrease` or more, the step went far along a weakly observable direction, and fails.
        accepted = bool(cost < self.cost) or (converged and cost - self.cost < self.min_decrease)
        self._record(solution, accepted)
        if accepted and candidate is full_step and self.is_undamped:
            plain = solution.chain, solution.calib
            self.accelerator.note(plain, plain, solution.decrease)
        else:
            self.accelerator.forget()
        if accepted:
            self.damping.after_success(curved, (self.cost - cost) / max(solution.decrease, 1e-300))
            self._move_to(candidate, cost)
        return accepted, converged

    def raise_damping(self, solution: Solution) -> bool:
        """Raises the damping after a failed step, for another attempt. Returns False if the solver should end
        instead."""
        self.n_stalled += solution.decrease < STALLED_DECREASE
        is_resting = self.is_early and solution.decrease < RESTING_RATIO * self.min_decrease
        if self.n_stalled > MAX_STALLED_STEPS or is_resting:
            return False
        self.damping.after_failure()
        if self.damping.value > MAX_DAMPING:
            return False
        self.cost = self._linearise(self.state)
        return True

    def end(self) -> Outcome:
        """The outcome at the present state, with the sums computed again if necessary."""
        last = self.steps[-1]
        if self.is_early:
            if not last.accepted:  # residuals are those of the failed step
                self._linearise(self.state, sums=False)
            return outcome_of(self._linearised, last.predicted_decrease, self.steps)
        if not (self.damping.curved and last.accepted):
            self._linearise(self.state, curved=True)
        solution = self._solve(0.0)
        self.options.on_visit(Visit(self.state, solution.information))
        return self.outcome(solution)

    def outcome(self, solution: Solution, remaining_decrease: float | None = None) -> Outcome:
        """The outcome with the undamped `solution` at the present state. remaining_decrease: predicted further decrease
        of half the chi^2, by default that of `solution`."""
        remaining_decrease = solution.decrease if remaining_decrease is None else remaining_decrease
        return outcome_of(self._linearised, remaining_decrease, self.steps, solution)

    @property
    def _linearised(self) -> Linearised:
        return Linearised(self.problem, self.state, self.cost, self.residuals)

    def _record(self, solution: Solution, accepted: bool) -> None:
        """Records a step, and passes it to `on_step`."""
        self.steps.append(Step(self.cost, solution.decrease, self.damping.value, accepted))
        self.options.on_step(self.steps[-1])

    def _move_to(self, state: State, cost: float) -> None:
        """Moves to `state`, at which the residuals were computed last."""
        self.state, self.cost, self.problem = state, cost, self.problem.warm_started(self.residuals)

    def _is_rounding(self, solution: Solution) -> bool:
        """Whether the next step would change nothing but rounding errors, so that the present sums are final."""
        min_decrease = min(ROUNDING_SHARE * self.cost, NEGLIGIBLE_DECREASE)
        return not self.is_early and self.damping.curved and self.is_undamped and solution.decrease < min_decrease

    def _final_step(self, solution: Solution) -> float | None:
        """Takes a step after which the remaining decrease, extrapolated from the last two steps, is negligible. Returns
        that remainder; None if there is no such step.

        The sums are not computed again at the new state, because they change in their last digits only. So no such step
        is taken if a parameter is known so badly that these digits matter.
        """
        can_end = self.damping.curved and self.is_undamped and self.steps and not self.is_early
        if not can_end or self.problem.fixed_directions.size:
            return None
        last, decrease = self.steps[-1], solution.decrease
        remaining_decrease = decrease * decrease / last.predicted_decrease if last.accepted else np.inf
        if not (
            remaining_decrease < NEGLIGIBLE_DECREASE
            and decrease < SMALL_DECREASE
            and essential_information(solution.information, self.problem.tolerance, self.problem.layout)
            > DETERMINED_ABOVE
        ):
            return None
        candidate = self.state.retract(self.problem.layout, solution.chain, solution.calib)
        cost = self._linearise(candidate, sums=False, curved=True)
        if not cost - self.cost < ROUNDING_SHARE * self.cost:
            self.cost = self._linearise(self.state, curved=True)
            return None
        self._record(solution, True)
        self._move_to(candidate, cost)
        return remaining_decrease

    def _accelerated_step(self, solution: Solution, curved: bool) -> bool:
        """Tries an Anderson-accelerated step if plain ones converge slowly. Returns whether it is accepted."""
        if not self.is_undamped or solution.decrease < self.min_decrease:
            return False
        accelerated = self.accelerator.step(solution.chain, solution.calib, solution.decrease)
        if accelerated is None:
            return False
        candidate = self.state.retract(self.problem.layout, *accelerated)
        cost = self._linearise(candidate, True, curved)
        if not cost < self.cost - MIN_ACCELERATED_GAIN * solution.decrease:
            self.accelerator.forget()
            return False
        self._record(solution, True)
        self.accelerator.note((solution.chain, solution.calib), accelerated, solution.decrease)
        self._move_to(candidate, cost)
        return True

    def _linear_step_cost(self, solution: Solution, state: State, curved: bool) -> float | None:
        """Cost at `state`, after a step that may end an early pass although its predicted decrease is not small. The
        decrease equals the predicted one, so the problem is linear along the step. None for other steps."""
        if not (self.is_early and self.is_undamped and self.min_decrease < solution.decrease < MAX_LINEAR_DECREASE):
            return None
        if self.accelerator.slow(solution.decrease):  # slow convergence: the problem is not linear
            return None
        cost = self._linearise(state, sums=False, curved=curved)
        mismatch = abs(self.cost - cost - solution.decrease)
        return cost if mismatch < MAX_LINEAR_MISMATCH * self.options.tolerance else None

    def _line_search(self, solution: Solution, state: State, cost: float, curved: bool) -> tuple[State, float]:
        """Line search: an overshooting step to `state`, at `cost`, is cut to about half, at the minimum of a parabola.
        Returns the better state and its cost.

        The sums may have only half the true curvature of a weakly observable parameter, such as the time offset of
        wheels in a steady turn. Steps then jump from one side of the minimum to the other.
        """
        gain = (self.cost - cost) / solution.decrease if solution.decrease > 0.0 else 1.0
        if not -OVERSHOOT_GAIN < gain < OVERSHOOT_GAIN:
            return state, cost
        fraction = 1.0 / (2.0 - gain)
        candidate = self.state.retract(self.problem.layout, fraction * solution.chain, fraction * solution.calib)
        candidate_cost = self._linearise(candidate, True, curved)
        if candidate_cost < cost:
            return candidate, candidate_cost
        return state, self._linearise(state, True, curved)

    def _second_order_correction(self, state: State, cost: float, curved: bool) -> tuple[State, float]:
        """Second-order correction: if a candidate step, linearised at `state`, raises the cost, takes further steps
        from it while each removes most of the excess (ratio < MAX_CORRECTION_RATIO). Returns state and cost.

        A weakly observable direction, such as gravity's on a straight drive, moves far in one step. A step along the
        tangent of a curved valley leaves it by the square of its length; the next ones return. With more damping
        instead, the solver would converge slowly. An excess within rounding counts as none: it would never be less.
        """
        ratio, least = 0.0, self.cost
        while cost - least >= ROUNDING_SHARE * least and ratio < MAX_CORRECTION_RATIO:
            try:
                solution = self._solve(max(self.damping.value, CORRECTION_DAMPING))
            except NotDefiniteError:
                break
            state = state.retract(self.problem.layout, solution.chain, solution.calib)
            cost_before, cost = cost, self._linearise(state, True, curved)
            excess_before = max(cost_before - least, ROUNDING_SHARE * least)
            ratio = (cost - least) / excess_before if np.isfinite(cost) else np.inf
        return state, cost

    def _linearise(self, state: State, sums: bool = True, curved: bool = False) -> float:
        return self.problem.linearise(state, self.pieces, self.residuals, sums, curved)

    def _solve(self, damping: float) -> Solution:
        return self.problem.solve(self.pieces, damping)


# The outcome of a solve: state, residuals, steps, and draws from the posterior.

STALLED_DECREASE = 0.05  # of half the chi^2: a third of a standard deviation; converged if steps fail below it
N_JOINT_DRAWS, N_CHAIN_DRAWS = 2, 3  # posterior draws: with calibration parameters, and of the chain alone
# Upper bound of keyframes times `free` draws. Few keyframes need more: degrees of freedom used by the fit have an error
# of sqrt(2 used / draws), too large for few residuals. Doubled, draws cost twice as much, for 0.7 times the error.
DRAWS_TIMES_KEYFRAMES, MAX_JOINT_DRAWS = 640, 64
N_MORE_CHAIN_DRAWS = 5  # chain draws for unclear cases; drawn later, so that the first ones do not change


@dataclass(frozen=True)
class Step:
    """One iteration: half the robust chi^2 before it, the decrease that the linear model predicts, damping, and whether
    it was accepted."""

    cost: float
    predicted_decrease: float
    damping: float
    accepted: bool


@dataclass(frozen=True)
class Visit:
    """A state at which the solver computed a step, and the information (B, B) of the calibration parameters there,
    chain marginalised, damping included."""

    state: State
    information: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """End of a solve. problem: the solved problem, warm-started. cost: half the robust chi^2 at `state`. status: a
    sentence about convergence.

    information (B, B): of the calibration parameters at `state`, chain marginalised, undamped. It is empty, and draws
    are None, if another pass follows. stopped_early: stopped before convergence, because more steps seemed useless.
    workspace: the pieces of the solve, which another solve may overwrite; None without features.
    """

    problem: Problem
    state: State
    cost: float
    residuals: Residuals
    information: np.ndarray
    steps: tuple[Step, ...]
    converged: bool
    status: str
    draws: Draws | None = None
    stopped_early: bool = False
    workspace: tuple[Piece, ...] | None = None


@dataclass(frozen=True)
class Draws:
    """Steps drawn from the posterior. In `free` ones the calibration parameters vary, except along unobservable
    directions. In `still` ones all calibration parameters are fixed."""

    free: tuple[Draw, ...]
    still: tuple[Draw, ...]

    @classmethod
    def of(cls, solution: Solution) -> Draws:
        """Draws from the latest `solution`, before its pieces are filled anew."""
        rng, factors = np.random.default_rng(0), solution.factors
        drawn = factors.draws(rng, N_JOINT_DRAWS, N_CHAIN_DRAWS) + factors.draws(rng, 0, N_MORE_CHAIN_DRAWS)
        more = min(DRAWS_TIMES_KEYFRAMES // len(solution.chain), MAX_JOINT_DRAWS) - N_JOINT_DRAWS
        free = drawn[:N_JOINT_DRAWS] + (factors.draws(rng, more, 0) if more > 0 else ())
        return cls(free, drawn[N_JOINT_DRAWS:])


def relative_decrease(steps: Sequence[Step], cost: float) -> float:
    """Relative decrease of half the chi^2 from the start of `steps` to `cost`, (start - cost) / cost; 0 without steps
    or if the cost is 0."""
    return steps[0].cost / cost - 1.0 if steps and cost > 0.0 else 0.0


class Linearised(NamedTuple):
    """A problem and its residuals at `state`. cost: half the robust chi^2."""

    problem: Problem
    state: State
    cost: float
    residuals: Residuals


def outcome_of(
    end: Linearised, remaining_decrease: float, steps: Sequence[Step], solution: Solution | None = None
) -> Outcome:
    """The outcome at `end`. remaining_decrease: predicted further decrease of half the chi^2. solution: undamped, at
    `end`; None if another pass follows."""
    converged = remaining_decrease < STALLED_DECREASE
    status = _status(end.cost, remaining_decrease, len(steps))
    outcome = Outcome(*end, NO_DIRECTIONS, tuple(steps), converged, status)
    if solution is None:
        return outcome
    pieces = solution.factors.pieces
    workspace = pieces if any(p.features is not None for p in pieces) else None
    return replace(outcome, information=solution.information, draws=Draws.of(solution), workspace=workspace)


def _status(cost: float, remaining_decrease: float, n_steps: int) -> str:
    """A sentence about convergence after `n_steps` iterations."""
    if remaining_decrease < STALLED_DECREASE:
        # A decrease d of half the chi^2 is a step of at most sqrt(2 d) standard deviations.
        percent = max(100.0 * np.sqrt(2.0 * max(remaining_decrease, 0.0)), 1.0)
        return (
            f"converged in {n_steps} iteration{'s' * (n_steps != 1)} of the last pass: the next step would move no "
            f"parameter by more than {percent:.0f} % of its standard deviation."
        )
    return (
        f"not converged after {n_steps} iterations: the next step would still lower half the chi^2 of {cost:.6g} by "
        f"{remaining_decrease:.3g}; give a better initial guess, or check the noise in the rig file."
    )


def posterior(problem: Problem, state: State) -> Draws:
    """Draws from the posterior at `state`. Raises NotDefiniteError."""
    pieces = problem.pieces()
    problem.linearise(state, pieces, problem.residuals(), curved=True)
    return Draws.of(problem.solve(pieces))
