"""Levenberg-Marquardt on the manifold. It knows a problem only by its sums."""

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
# Half a chi^2 of 5e-4 is a step of 0.03 standard deviations at most, in any direction.
CONVERGED_DECREASE = 5e-4
ROUNDING_SHARE = 1e-11  # of the cost: what rounding makes of a sum of 1e6 squares
CURVED_BELOW_SHARE = 1e-2  # of the cost: steps that promise less use the true curvature of the robust loss
EARLY_STOP_DECREASE = 0.5  # of half the chi^2: where little more is gained, unobservable directions show
MAX_STALLED_STEPS = 4  # steps this small that fail before the solver rests
# of what a step costs too much, where its error is of second order: this much at most is left next
MAX_CORRECTION_RATIO = 0.25
MAX_LINEAR_DECREASE, MAX_LINEAR_MISMATCH = (
    1e3,
    0.1,
)  # of half the chi^2; of an early pass's tolerance: how well a larger step may be foretold
OVERSHOOT_GAIN = 0.5  # of what a step promises: one that gains or costs less than this is too long
CORRECTION_DAMPING = 1e-6  # damping of a step that comes back: across a valley, not along it
CREEPING_STEPS = 2  # steps, of the least of which the next one must promise less than half; with one, any bend would do
RESTING_RATIO = 20.0  # times the tolerance of an early pass: a step that promises less and fails ends it
MIN_DAMPING = 1e-8
SMALL_DECREASE = 0.5  # of half the chi^2: a step of one standard deviation, all parameters together
NEGLIGIBLE_DECREASE = 2e-5  # of half the chi^2: a step of 0.006 standard deviations: too small to linearise again


class _DampingSchedule(NamedTuple):
    """Of damping: what it is at first; by what it grows with a failure, by its square with the next, ...; by what it
    shrinks where one good step follows another; and below what there is none: the weak information of a planar drive
    must not be swamped."""

    first: float
    more: float
    less: float
    none: float


CAREFUL_DAMPING = _DampingSchedule(1e-6, 2.0, 0.1, 1e-10)
EARLY_DAMPING = _DampingSchedule(1e-4, 8.0, 0.01, 2e-6)  # where a pass is only to lead near
# Nielsen 1999, "Damping parameter in Marquardt's method": by what it shrinks after a failure
MIN_FACTOR_AFTER_FAILURE = 1.0 / 3.0
MIN_GAIN_RATIO = 0.25  # of what a step promises: with less, damping does not shrink


@dataclass
class _DampingControl:
    """How steps are shortened: by damping, at its `pace`, and by weights alone in place of the true curvature of the
    loss, which the sums have (`curved`) where a step promises less than `curved_below` of the cost."""

    pace: _DampingSchedule
    damping: float = 0.0
    curved: bool = False
    curved_below: float = CURVED_BELOW_SHARE
    failures: int = 0  # since the last step that was taken

    def less(self, near: bool, gain: float) -> None:
        """After a step that was taken, with its gain over the predicted one, to sums that have the true curvature where
        `near`. Damping that a failed step asked for shrinks slowly: with much less the next step would fail, too."""
        self.curved = near
        if gain > MIN_GAIN_RATIO:
            least = MIN_FACTOR_AFTER_FAILURE if self.failures else self.pace.less
            self.damping *= max(least, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
        self.failures = 0
        self.damping = 0.0 if self.damping < self.pace.none else self.damping

    def more(self) -> None:
        """After one that failed: too far out for the true curvature, so weights alone, and only then more damping."""
        if self.curved:
            self.curved_below *= 0.1
        else:
            self.failures += 1
            self.damping = max(self.damping * self.pace.more**self.failures, self.pace.first)
        self.curved = False


@dataclass
class _Descent:
    """Where the solver stands: `cost` at `state`, of which `pieces` and `residuals` hold the sums; stalled: how many
    small steps have failed."""

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
        """At `state`, before any step."""
        pieces, residuals = room or problem.pieces(), problem.residuals()
        cost = problem.linearise(state, pieces, residuals)
        return cls(problem, state, tolerance, share, on_step, pieces, residuals, cost)

    @property
    def early(self) -> bool:
        """Whether another pass follows."""
        return self.tolerance > STALLED_DECREASE

    @property
    def enough(self) -> float:
        """A decrease too small for a further step."""
        return max(self.tolerance, self.share * self.cost)

    @property
    def free(self) -> bool:
        """Whether steps are not damped."""
        return self.care.damping == 0.0

    def solution(self) -> Solution:
        """Of the sums, with the least damping, from that in use up, that makes them definite."""
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
        """Whether nothing that counts would change: the sums are those of the end already."""
        counts = min(ROUNDING_SHARE * self.cost, NEGLIGIBLE_DECREASE)
        return not self.early and self.care.curved and self.free and solution.decrease < counts

    def creeps(self, solution: Solution) -> bool:
        """Whether steps have ceased to promise less and less: Gauss and Newton's do where the measurements determine
        all, and wander where noise leads. One that failed is no step: the next promises about as much as it did. Nor is
        a damped one: with less damping the next promises more."""
        before = [
            step.predicted_decrease for step in self.steps[-CREEPING_STEPS:] if step.accepted and step.damping == 0.0
        ]
        return len(before) == CREEPING_STEPS and solution.decrease > 0.5 * min(before)

    def let_go(self, priors: Sequence[Prior], solution: Solution) -> Solution:
        """The solution where `priors` count no more: what they add to the calibration parameters is known, so nothing
        is solved."""
        cost, gradient, information = sums_of_priors(priors, self.state, self.problem.layout.size)
        self.problem, self.cost = self.problem.without(priors), self.cost - cost
        return solution.less(information, gradient)

    def last_step(self, solution: Solution) -> float | None:
        """Takes a step after which nothing that counts is left, as steps become less and less, and says how much; None
        where it is no such step. The sums at hand, of where it began, are those of the end for all but the last digits,
        so none is taken where something is known so badly that these count."""
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
        """Keeps a record of a step."""
        self.steps.append(Step(self.cost, solution.decrease, self.care.damping, taken))
        self.on_step(self.steps[-1])

    def step(self, solution: Solution, second_order: bool) -> tuple[bool, bool]:
        """Whether the step is taken, and whether it is the last one."""
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
        # At the bottom rounding decides whether the cost falls; a step that promises this little is taken anyway, but
        # not where it goes far along what the data hardly tell, and the cost rises.
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
        """Takes an accelerated step where plain ones converge slowly, and says whether it did."""
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
        """After a step that failed: with more care, unless nothing comes of it."""
        self.stalled += solution.decrease < STALLED_DECREASE
        if self.stalled > MAX_STALLED_STEPS or (self.early and solution.decrease < RESTING_RATIO * self.enough):
            return False
        self.care.more()
        if self.care.damping > 1e6:
            return False
        self.cost = self._linearise(self.state)
        return True

    def end(self, on_visit: Callable[[Visit], None]) -> Outcome:
        """The outcome here."""
        last = self.steps[-1]
        if self.early:
            if not last.accepted:  # what was filled last is not that of `state`
                self._linearise(self.state, sums=False)
            return outcome_of(self.problem, self.state, self.cost, self.residuals, last.predicted_decrease, self.steps)
        if not (self.care.curved and last.accepted):
            self._linearise(self.state, curved=True)
        solution = self._solve(0.0)
        on_visit(Visit(self.state, solution.information))
        return self.outcome(solution)

    def outcome(self, end: Solution, left: float | None = None) -> Outcome:
        """With what was solved here, or where this is the end of the last step, which leaves so much."""
        left = end.decrease if left is None else left
        return outcome_of(self.problem, self.state, self.cost, self.residuals, left, self.steps, end)

    def _straight(self, solution: Solution, state: State, curved: bool) -> float | None:
        """What a step to `state` costs, where an early pass may end with it although it is not small: it gains just
        what the sums say, so that nothing bends on its way, and next to nothing is left behind it. Else None."""
        if not (self.early and self.free and self.enough < solution.decrease < MAX_LINEAR_DECREASE):
            return None
        if self.accelerator.slow(solution.decrease):  # something bends
            return None
        cost = self._linearise(state, sums=False, curved=curved)
        return cost if abs(self.cost - cost - solution.decrease) < MAX_LINEAR_MISMATCH * self.tolerance else None

    def _shortened(self, solution: Solution, state: State, cost: float, curved: bool) -> tuple[State, float]:
        """Of a step to `state`, at `cost`, that overshoots, about half, to where a parabola has its least; and what
        that costs.

        Where little is known, of wheels' clock in a steady turn for one, the sums may have but half of the true
        curvature: then steps jump from one side of the least to the other.
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
    """Minimises `problem` from `state` until half the chi^2 can fall by less than `tolerance`, or this share of it.

    `on_visit` is told of each state that a step was looked for from, and of the last. Where the tolerance is wide
    another pass follows, and the end is not linearised once more: the outcome has no information and no draws.
    `second_order`: steps may go as far as the next ones can make good, see `_Descent`. `leaves`: asked with
    how far it has come, as a share of half the chi^2, and the calibration parameters' information (B, B), whether to
    end when half the chi^2 can fall by less than EARLY_STOP_DECREASE, or a step not far from there fails, or steps
    creep. `priors_to_drop`: asked before it, with the same, which priors are to count no more from where half the chi^2
    can fall by less than EARLY_STOP_DECREASE. `room`: of an outcome of a problem with the same features, to be used
    again.

    Raises EstimationError if no step can be computed at all.
    """
    at = _Descent.begin(problem, state, tolerance, share, on_step, room)
    for _ in range(MAX_ITERATIONS):
        solution = at.solution()
        on_visit(Visit(at.state, solution.information))
        if at.free and solution.decrease < EARLY_STOP_DECREASE:
            gone = priors_to_drop(relative_decrease(at.steps, at.cost), solution.information)
            solution = at.let_go(gone, solution) if gone else solution
        creeps = at.creeps(solution)
        low = creeps or (at.free and solution.decrease < RESTING_RATIO * EARLY_STOP_DECREASE)
        asked = low and leaves is not None and leaves(relative_decrease(at.steps, at.cost), solution.information)
        if asked and (creeps or solution.decrease < EARLY_STOP_DECREASE) and (at.free or at.early):
            return replace(at.outcome(solution) if at.free else at.end(on_visit), stopped_early=True)
        if at.has_ended(solution):
            at.note(solution, True)
            return at.outcome(solution)
        if (left := at.last_step(solution)) is not None:
            on_visit(Visit(at.state, solution.information))
            return at.outcome(solution, left)
        taken, converged = at.step(solution, second_order)
        if converged:
            break
        if taken:
            continue
        if asked:
            return replace(at.end(on_visit), stopped_early=True)
        if not at.tries_again(solution):
            break
    return at.end(on_visit)
