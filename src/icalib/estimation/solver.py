"""Levenberg-Marquardt on the manifold. It knows a problem only by its sums."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.estimation.arrowhead import NotDefiniteError, solve
from icalib.estimation.problem import Problem, Residuals
from icalib.estimation.state import State

MAX_ITERATIONS = 50
# Half a chi^2 of 5e-4 is a step of 0.03 standard deviations at most, in any direction.
CONVERGED_DECREASE = 5e-4
ROUNDING = 1e-11  # of the cost: what rounding makes of a sum of 1e6 squares
CURVED_BELOW = 1e-2  # of the cost: steps that promise less use the true curvature of the robust loss
STALLED_DECREASE = 0.05  # of half the chi^2: a third of a standard deviation, good enough where smaller steps fail
MOST_STALLED = 4  # steps this small that fail before the solver rests
RESTING = 20.0  # times the tolerance of an early pass: a step that promises less and fails ends it
FIRST_DAMPING = 1e-8
ZERO_DAMPING = 1e-10  # below this, none: the weak information of a planar drive must not be swamped


@dataclass(frozen=True)
class Step:
    """One iteration: half the robust chi^2 before it, the decrease that the linear model promises, and its fate."""

    cost: float
    predicted_decrease: float
    damping: float
    accepted: bool


@dataclass(frozen=True)
class Visit:
    """Where the solver stood when it looked for a step: the state, and the border's information (B, B) there, the chain
    marginalised (damping included)."""

    state: State
    information: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """Where the solver ended, with a status that is a sentence."""

    state: State
    cost: float
    residuals: Residuals
    information: np.ndarray  # (B, B) of the border at the last linearisation, the chain marginalised, no damping
    steps: tuple[Step, ...]
    converged: bool
    status: str


def minimise(
    problem: Problem,
    state: State,
    on_step: Callable[[Step], None] = lambda _: None,
    tolerance: float = CONVERGED_DECREASE,
    on_visit: Callable[[Visit], None] = lambda _: None,
) -> Outcome:
    """Minimises `problem` from `state` until half the chi^2 can fall by less than `tolerance`. `on_visit` is told of
    each state that a step was looked for from, and of the last.

    Raises EstimationError if no step can be computed at all.
    """
    pieces, residuals = problem.pieces(), problem.residuals()
    cost = problem.linearise(state, pieces, residuals)
    damping, curved, curved_below, stalled, steps = 0.0, False, CURVED_BELOW, 0, []
    for _ in range(MAX_ITERATIONS):
        if not np.isfinite(cost):
            raise EstimationError(
                "the first guess predicts no finite measurement; give a better guess in the rig file."
            )
        solution, damping = _solve(problem, state, pieces, residuals, damping, curved)
        on_visit(Visit(state, solution.information))
        candidate = state.retract(problem.layout, solution.chain, solution.border)
        settled = solution.decrease < curved_below * cost
        candidate_cost = problem.linearise(candidate, pieces, residuals, curved=settled)
        converged = damping == 0.0 and solution.decrease < max(tolerance, ROUNDING * cost)
        # At the bottom rounding decides whether the cost falls; a step this small is taken anyway.
        accepted = bool(candidate_cost < cost) or converged
        steps.append(Step(cost, solution.decrease, damping, accepted))
        on_step(steps[-1])
        if accepted:
            good = cost - candidate_cost > 0.25 * solution.decrease
            state, cost, curved = candidate, candidate_cost, settled
            damping = damping * (0.1 if good else 1.0)
            damping = 0.0 if damping < ZERO_DAMPING else damping
            if converged:
                break
            continue
        stalled += solution.decrease < STALLED_DECREASE
        if stalled > MOST_STALLED or (tolerance > STALLED_DECREASE and solution.decrease < RESTING * tolerance):
            break
        # Too far out for the true curvature of the loss: weights alone, and only then more damping.
        damping = damping if curved else max(damping * 10.0, 1e-6)
        curved_below = curved_below * (0.1 if curved else 1.0)
        curved = False
        if damping > 1e6:
            break
        cost = problem.linearise(state, pieces, residuals)
    fresh = curved and bool(steps) and steps[-1].accepted  # the sums are those of `state` already
    outcome = _finish(problem, state, cost, pieces, residuals, steps, fresh)
    on_visit(Visit(outcome.state, outcome.information))
    return outcome


def _solve(problem, state, pieces, residuals, damping, curved):
    """Solves with the least damping, from `damping` up, that makes the sums definite."""
    while True:
        try:
            return solve(pieces, problem.n_nodes, problem.tolerance, damping, problem.held), damping
        except NotDefiniteError:
            damping = max(10.0 * damping, FIRST_DAMPING)
            if damping > 1e3:
                raise
            problem.linearise(state, pieces, residuals, curved=curved)


def _finish(problem, state, cost, pieces, residuals, steps, fresh) -> Outcome:
    if not fresh:
        problem.linearise(state, pieces, residuals, curved=True)
    last = solve(pieces, problem.n_nodes, problem.tolerance, 0.0, problem.held)
    converged, n = last.decrease < STALLED_DECREASE, len(steps)
    # Half a chi^2 of d is a step of sqrt(2 d) standard deviations at most.
    share = max(100.0 * np.sqrt(2.0 * max(last.decrease, 0.0)), 1.0)
    status = (
        f"converged in {n} iterations: the next step would move no parameter by more than {share:.0f} % of its "
        "standard deviation."
        if converged
        else f"not converged after {n} iterations: the next step would still lower half the chi^2 of {cost:.6g} by "
        f"{last.decrease:.3g}; give a better first guess, or check the noise in the rig file."
    )
    return Outcome(state, cost, residuals, last.information, tuple(steps), converged, status)
