"""Levenberg-Marquardt on the manifold: the loop over steps, and early stopping."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from icalib.estimate.problem.descent import RESTING_RATIO, Descent
from icalib.estimate.problem.outcome import Outcome, Visit, relative_decrease
from icalib.estimate.problem.problem import Problem
from icalib.estimate.problem.solver_options import DEFAULT_OPTIONS, SolverOptions
from icalib.optim.arrowhead import Piece, Solution
from icalib.optim.state import State

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
