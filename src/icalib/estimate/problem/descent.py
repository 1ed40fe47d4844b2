"""State of the Levenberg-Marquardt solver, and its steps on the manifold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.problem.damping import CAREFUL_DAMPING, EARLY_DAMPING, Damping
from icalib.estimate.problem.outcome import STALLED_DECREASE, Linearised, Outcome, Step, Visit, outcome_of
from icalib.estimate.problem.problem import Problem
from icalib.estimate.problem.solver_options import ROUNDING_SHARE, SolverOptions
from icalib.motion.factor import Residuals
from icalib.optim.anderson import MIN_ACCELERATED_GAIN, Accelerator
from icalib.optim.arrowhead import NotDefiniteError, Piece, Solution
from icalib.optim.calib_block import DETERMINED_ABOVE, essential_information
from icalib.optim.prior_factor import Prior, sums_of_priors
from icalib.optim.state import State

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
