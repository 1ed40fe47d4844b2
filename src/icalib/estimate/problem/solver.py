"""Levenberg-Marquardt on the manifold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.problem.outcome import STALLED_DECREASE, Outcome, Step, Visit, outcome_of, relative_decrease
from icalib.estimate.problem.problem import Problem
from icalib.motion.factor import Residuals
from icalib.optim.anderson import MIN_ACCELERATED_GAIN, Accelerator
from icalib.optim.arrowhead import NotDefiniteError, Piece, Solution, solve
from icalib.optim.calib_block import DETERMINED_ABOVE, essential_information
from icalib.optim.prior_factor import Prior, sums_of_priors
from icalib.optim.state import State

MAX_ITERATIONS = 50
# A decrease of half the chi^2 by 5e-4 is a step of at most 0.03 standard deviations, in any direction.
CONVERGED_DECREASE = 5e-4
ROUNDING_SHARE = 1e-11  # of the cost: rounding error of a sum of 1e6 squares
CURVED_BELOW_SHARE = 1e-2  # of the cost: steps that predict less use the true curvature of the robust loss
EARLY_STOP_DECREASE = 0.5  # of half the chi^2: below this predicted decrease, early stopping is considered
MAX_STALLED_STEPS = 4  # failed steps with a predicted decrease below STALLED_DECREASE, before the solver ends
# of the excess cost: second-order correction continues while each of its steps leaves at most this share
MAX_CORRECTION_RATIO = 0.25
# of half the chi^2; of the tolerance: predicted decrease, and error of the prediction, of a linear step at most
MAX_LINEAR_DECREASE, MAX_LINEAR_MISMATCH = (
    1e3,
    0.1,
)
OVERSHOOT_GAIN = 0.5  # actual over predicted decrease: a step with a smaller absolute value overshoots
CORRECTION_DAMPING = 1e-6  # of steps of the second-order correction: they move across a valley, not along it
# Convergence is slow if a step predicts over half of the least of so many before. With 1, any nonlinearity would count.
CREEPING_STEPS = 2
RESTING_RATIO = 20.0  # times the tolerance of an early pass: a step that predicts less and fails ends the pass
MIN_DAMPING = 1e-8  # first damping if the undamped normal equations are not positive definite
SMALL_DECREASE = 0.5  # of half the chi^2: a step of one standard deviation, all parameters together
NEGLIGIBLE_DECREASE = 2e-5  # of half the chi^2: a step of 0.006 standard deviations: too small to linearise again


class _DampingSchedule(NamedTuple):
    """Damping schedule. first: least damping after a failed step. more: growth factor after a failure; its powers after
    successive failures. less: smallest reduction factor after successive good steps. none: damping below it is set to
    0, so that it does not swamp the weak information of a planar drive."""

    first: float
    more: float
    less: float
    none: float


CAREFUL_DAMPING = _DampingSchedule(1e-6, 2.0, 0.1, 1e-10)
EARLY_DAMPING = _DampingSchedule(1e-4, 8.0, 0.01, 2e-6)  # for a pass that need not converge
# Nielsen 1999, "Damping parameter in Marquardt's method": smallest reduction factor of damping after a failure
MIN_FACTOR_AFTER_FAILURE = 1.0 / 3.0
MIN_GAIN_RATIO = 0.25  # actual over predicted decrease: below it damping is not reduced


@dataclass
class _DampingControl:
    """Damping, and the curvature of the robust loss in the sums. pace: damping schedule. curved: whether the sums have
    the true curvature, instead of weights alone. curved_below: share of the cost; steps with a smaller predicted
    decrease use the true curvature."""

    pace: _DampingSchedule
    damping: float = 0.0
    curved: bool = False
    curved_below: float = CURVED_BELOW_SHARE
    failures: int = 0  # since the last step that was taken

    def less(self, near: bool, gain: float) -> None:
        """Update after an accepted step. near: whether its sums have the true curvature. gain: actual over predicted
        decrease. After a failure damping is reduced slowly, because with much less the next step would fail, too."""
        self.curved = near
        if gain > MIN_GAIN_RATIO:
            least = MIN_FACTOR_AFTER_FAILURE if self.failures else self.pace.less
            self.damping *= max(least, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
        self.failures = 0
        self.damping = 0.0 if self.damping < self.pace.none else self.damping

    def more(self) -> None:
        """Update after a failed step: first the true curvature is replaced by weights alone, then damping grows."""
        if self.curved:
            self.curved_below *= 0.1
        else:
            self.failures += 1
            self.damping = max(self.damping * self.pace.more**self.failures, self.pace.first)
        self.curved = False


@dataclass
class _Descent:
    """State of the solver. cost: half the robust chi^2 at `state`; pieces and residuals: filled at `state`. stalled:
    number of small steps that failed."""

    problem: Problem
    state: State
    tolerance: float
    share: float
    on_step: Callable[[Step], None]
    pieces: tuple[Piece, ...]
    residuals: Residuals
    cost: float
    steps: list[Step] = field(default_factory=list)
    care: _DampingControl = field(init=False)
    stalled: int = 0
    accelerator: Accelerator = field(default_factory=Accelerator)

    def __post_init__(self) -> None:
        self.care = _DampingControl(EARLY_DAMPING if self.early else CAREFUL_DAMPING)

    @classmethod
    def begin(
        cls,
        problem: Problem,
        state: State,
        tolerance: float,
        share: float,
        on_step: Callable[[Step], None],
        room: tuple[Piece, ...] | None = None,
    ) -> _Descent:
        """The solver before its first step. room: pieces to be reused as workspace."""
        pieces, residuals = room or problem.pieces(), problem.residuals()
        cost = problem.linearise(state, pieces, residuals)
        return cls(problem, state, tolerance, share, on_step, pieces, residuals, cost)

    @property
    def early(self) -> bool:
        """Whether another pass follows; then the tolerance is wide."""
        return self.tolerance > STALLED_DECREASE

    @property
    def enough(self) -> float:
        """Decrease of half the chi^2 that is too small for a further step."""
        return max(self.tolerance, self.share * self.cost)

    @property
    def free(self) -> bool:
        """Whether steps are undamped."""
        return self.care.damping == 0.0

    def solution(self) -> Solution:
        """Solves the normal equations. Damping is raised from its present value until they are positive definite.
        Raises EstimationError."""
        if not np.isfinite(self.cost):
            raise EstimationError(
                "the initial guess predicts no finite measurement; give a better guess in the rig file."
            )
        while True:
            try:
                return self._solve(self.care.damping)
            except NotDefiniteError:
                self.care.damping = max(10.0 * self.care.damping, MIN_DAMPING)
                if self.care.damping > 1e3:
                    raise
                self._linearise(self.state, curved=self.care.curved)

    def has_ended(self, solution: Solution) -> bool:
        """Whether the next step would change nothing but rounding errors, so that the present sums are final."""
        counts = min(ROUNDING_SHARE * self.cost, NEGLIGIBLE_DECREASE)
        return not self.early and self.care.curved and self.free and solution.decrease < counts

    def creeps(self, solution: Solution) -> bool:
        """Whether convergence is slow: the predicted decrease is more than half the least of the last undamped steps.
        It shrinks quickly if the measurements determine all parameters, and not along directions that only noise
        determines. Failed and damped steps are not compared, because the next step does not predict less after them."""
        before = [
            step.predicted_decrease for step in self.steps[-CREEPING_STEPS:] if step.accepted and step.damping == 0.0
        ]
        return len(before) == CREEPING_STEPS and solution.decrease > 0.5 * min(before)

    def let_go(self, priors: Sequence[Prior], solution: Solution) -> Solution:
        """The solution without `priors`, which are dropped from the problem. Their information and gradient on the
        calibration parameters are subtracted, so the chain is not eliminated again."""
        cost, gradient, information = sums_of_priors(priors, self.state, self.problem.layout.size)
        self.problem, self.cost = self.problem.without(priors), self.cost - cost
        return solution.less(information, gradient)

    def last_step(self, solution: Solution) -> float | None:
        """Takes a step after which the remaining decrease, extrapolated from the last two steps, is negligible. Returns
        that remainder; None if there is no such step.

        The sums are not computed again at the new state, because they change in their last digits only. So no such step
        is taken if a parameter is known so badly that these digits matter.
        """
        if self.early or not (self.care.curved and self.free and self.steps) or self.problem.fixed_directions.size:
            return None
        before, now = self.steps[-1], solution.decrease
        left = now * now / before.predicted_decrease if before.accepted else np.inf
        if not (
            left < NEGLIGIBLE_DECREASE
            and now < SMALL_DECREASE
            and essential_information(solution.information, self.problem.tolerance, self.problem.layout)
            > DETERMINED_ABOVE
        ):
            return None
        there = self.state.retract(self.problem.layout, solution.chain, solution.calib)
        cost = self._linearise(there, sums=False, curved=True)
        if not cost - self.cost < ROUNDING_SHARE * self.cost:
            self.cost = self._linearise(self.state, curved=True)
            return None
        self.note(solution, True)
        self.state, self.cost, self.problem = there, cost, self.problem.warm_started(self.residuals)
        return left

    def note(self, solution: Solution, taken: bool) -> None:
        """Records a step, and passes it to `on_step`."""
        self.steps.append(Step(self.cost, solution.decrease, self.care.damping, taken))
        self.on_step(self.steps[-1])

    def step(self, solution: Solution, second_order: bool) -> tuple[bool, bool]:
        """Tries a step. Returns whether it is accepted, and whether it is the last one."""
        near = solution.decrease < self.care.curved_below * self.cost
        if self._accelerated(solution, near):
            return True, False
        whole = there = self.state.retract(self.problem.layout, solution.chain, solution.calib)
        straight = self._straight(solution, there, near)
        converged = straight is not None or (self.free and solution.decrease < self.enough)
        sums = not (converged and self.early)
        cost = self._linearise(there, sums, near) if straight is None else straight
        if not (self.early or converged):
            there, cost = self._shortened(solution, there, cost, near)
        if second_order and sums and not (cost < self.cost or converged):
            there, cost = self._corrected(there, cost, near)
        # At the optimum rounding decides whether the cost falls, so a last step is accepted anyway. If the cost rises
        # by `enough` or more, the step went far along a weakly observable direction, and fails.
        taken = bool(cost < self.cost) or (converged and cost - self.cost < self.enough)
        self.note(solution, taken)
        if taken and there is whole and self.free:
            plain = solution.chain, solution.calib
            self.accelerator.note(plain, plain, solution.decrease)
        else:
            self.accelerator.forget()
        if taken:
            self.care.less(near, (self.cost - cost) / max(solution.decrease, 1e-300))
            self.state, self.cost, self.problem = there, cost, self.problem.warm_started(self.residuals)
        return taken, converged

    def _accelerated(self, solution: Solution, curved: bool) -> bool:
        """Tries an Anderson-accelerated step if plain ones converge slowly. Returns whether it is accepted."""
        if not self.free or solution.decrease < self.enough:
            return False
        best = self.accelerator.step(solution.chain, solution.calib, solution.decrease)
        if best is None:
            return False
        there = self.state.retract(self.problem.layout, *best)
        cost = self._linearise(there, True, curved)
        if not cost < self.cost - MIN_ACCELERATED_GAIN * solution.decrease:
            self.accelerator.forget()
            return False
        self.note(solution, True)
        self.accelerator.note((solution.chain, solution.calib), best, solution.decrease)
        self.state, self.cost, self.problem = there, cost, self.problem.warm_started(self.residuals)
        return True

    def tries_again(self, solution: Solution) -> bool:
        """Prepares another attempt after a failed step, with more damping. Returns False if the solver should end
        instead."""
        self.stalled += solution.decrease < STALLED_DECREASE
        if self.stalled > MAX_STALLED_STEPS or (self.early and solution.decrease < RESTING_RATIO * self.enough):
            return False
        self.care.more()
        if self.care.damping > 1e6:
            return False
        self.cost = self._linearise(self.state)
        return True

    def end(self, on_visit: Callable[[Visit], None]) -> Outcome:
        """The outcome at the present state."""
        last = self.steps[-1]
        if self.early:
            if not last.accepted:  # residuals are those of the failed step
                self._linearise(self.state, sums=False)
            return outcome_of(self.problem, self.state, self.cost, self.residuals, last.predicted_decrease, self.steps)
        if not (self.care.curved and last.accepted):
            self._linearise(self.state, curved=True)
        solution = self._solve(0.0)
        on_visit(Visit(self.state, solution.information))
        return self.outcome(solution)

    def outcome(self, end: Solution, left: float | None = None) -> Outcome:
        """The outcome with the solution `end`. left: predicted further decrease of half the chi^2, by default that of
        `end`."""
        left = end.decrease if left is None else left
        return outcome_of(self.problem, self.state, self.cost, self.residuals, left, self.steps, end)

    def _straight(self, solution: Solution, state: State, curved: bool) -> float | None:
        """Cost at `state`, after a step that may end an early pass although its predicted decrease is not small. The
        decrease equals the predicted one, so the problem is linear along the step. None for other steps."""
        if not (self.early and self.free and self.enough < solution.decrease < MAX_LINEAR_DECREASE):
            return None
        if self.accelerator.slow(solution.decrease):  # slow convergence: the problem is not linear
            return None
        cost = self._linearise(state, sums=False, curved=curved)
        return cost if abs(self.cost - cost - solution.decrease) < MAX_LINEAR_MISMATCH * self.tolerance else None

    def _shortened(self, solution: Solution, state: State, cost: float, curved: bool) -> tuple[State, float]:
        """Line search: an overshooting step to `state`, at `cost`, is cut to about half, at the minimum of a parabola.
        Returns the better state and its cost.

        The sums may have only half the true curvature of a weakly observable parameter, such as the time offset of
        wheels in a steady turn. Steps then jump from one side of the minimum to the other.
        """
        gain = (self.cost - cost) / solution.decrease if solution.decrease > 0.0 else 1.0
        if not -OVERSHOOT_GAIN < gain < OVERSHOOT_GAIN:
            return state, cost
        share = 1.0 / (2.0 - gain)
        short = self.state.retract(self.problem.layout, share * solution.chain, share * solution.calib)
        there = self._linearise(short, True, curved)
        if there < cost:
            return short, there
        return state, self._linearise(state, True, curved)

    def _corrected(self, state: State, cost: float, curved: bool) -> tuple[State, float]:
        """Second-order correction: if a candidate step, linearised at `state`, raises the cost, takes further steps
        from it while each removes most of the excess (share < MAX_CORRECTION_RATIO). Returns state and cost.

        A weakly observable direction, such as gravity's on a straight drive, moves far in one step. A step along the
        tangent of a curved valley leaves it by the square of its length; the next ones return. More damping would make
        the solver creep. An excess within rounding counts as none: it would never be less.
        """
        share, least = 0.0, self.cost
        while cost - least >= ROUNDING_SHARE * least and share < MAX_CORRECTION_RATIO:
            try:
                solution = self._solve(max(self.care.damping, CORRECTION_DAMPING))
            except NotDefiniteError:
                break
            state = state.retract(self.problem.layout, solution.chain, solution.calib)
            before, cost = cost, self._linearise(state, True, curved)
            share = (cost - least) / max(before - least, ROUNDING_SHARE * least) if np.isfinite(cost) else np.inf
        return state, cost

    def _linearise(self, state: State, sums: bool = True, curved: bool = False) -> float:
        return self.problem.linearise(state, self.pieces, self.residuals, sums, curved)

    def _solve(self, damping: float) -> Solution:
        return solve(
            self.pieces, self.problem.n_keyframes, self.problem.tolerance, damping, self.problem.fixed_directions
        )


def minimise(
    problem: Problem,
    state: State,
    on_step: Callable[[Step], None] = lambda _: None,
    tolerance: float = CONVERGED_DECREASE,
    on_visit: Callable[[Visit], None] = lambda _: None,
    share: float = ROUNDING_SHARE,
    second_order: bool = True,
    leaves: Callable[[float, np.ndarray], bool] | None = None,
    priors_to_drop: Callable[[float, np.ndarray], Sequence[Prior]] = lambda *_: (),
    room: tuple[Piece, ...] | None = None,
) -> Outcome:
    """Minimises `problem` from `state` until the predicted decrease of half the chi^2 is below `tolerance`, or below
    `share` of it.

    on_step, on_visit: called with each step, and with each state at which a step is computed. A tolerance above
    STALLED_DECREASE means that another pass follows: the outcome has no information and no draws. second_order: whether
    steps that raise the cost are corrected, see `_Descent._corrected`.

    leaves: whether to stop early (rank deficient or out of date), given the relative cost decrease so far and the
    information (B, B) of the calibration parameters. It is called if the predicted decrease is below
    EARLY_STOP_DECREASE, if a step near that fails, or if convergence is slow. priors_to_drop: priors to remove, given
    the same, before `leaves` is called. room: pieces of an outcome with the same features, reused as workspace.

    Raises EstimationError if no step can be computed at all.
    """
    at = _Descent.begin(problem, state, tolerance, share, on_step, room)
    for _ in range(MAX_ITERATIONS):
        solution = at.solution()
        on_visit(Visit(at.state, solution.information))
        if at.free and solution.decrease < EARLY_STOP_DECREASE:
            gone = priors_to_drop(relative_decrease(at.steps, at.cost), solution.information)
            solution = at.let_go(gone, solution) if gone else solution
        creeps = at.creeps(solution)  # converges slowly, as along an unobservable direction
        low = creeps or (at.free and solution.decrease < RESTING_RATIO * EARLY_STOP_DECREASE)
        asked = low and leaves is not None and leaves(relative_decrease(at.steps, at.cost), solution.information)
        if asked and (creeps or solution.decrease < EARLY_STOP_DECREASE) and (at.free or at.early):
            return replace(at.outcome(solution) if at.free else at.end(on_visit), stopped_early=True)
        if at.has_ended(solution):  # the step would only change rounding errors
            at.note(solution, True)
            return at.outcome(solution)
        if (left := at.last_step(solution)) is not None:  # a step without new normal equations suffices
            on_visit(Visit(at.state, solution.information))
            return at.outcome(solution, left)
        taken, converged = at.step(solution, second_order)
        if converged:
            break
        if taken:
            continue
        if asked:  # the step failed near EARLY_STOP_DECREASE
            return replace(at.end(on_visit), stopped_early=True)
        if not at.tries_again(solution):
            break
    return at.end(on_visit)
