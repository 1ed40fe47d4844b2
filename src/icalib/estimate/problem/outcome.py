"""The outcome of a solve: state, residuals, steps, and draws from the posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icalib.estimate.problem.problem import Problem
from icalib.motion.factor import Residuals
from icalib.optim.arrowhead import Draw, Piece, Solution
from icalib.optim.calib_block import NO_DIRECTIONS
from icalib.optim.state import State

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
