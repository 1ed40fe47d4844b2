"""The outcome of a solve: state, residuals, steps, and draws from the posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.estimate.problem.problem import Problem
from icalib.motion.factor import Residuals
from icalib.optim.arrowhead import Draw, Piece, Solution, solve
from icalib.optim.calib_block import NO_DIRECTIONS
from icalib.optim.state import State

STALLED_DECREASE = 0.05  # of half the chi^2: a third of a standard deviation, good enough where smaller steps fail
N_JOINT_DRAWS, N_CHAIN_DRAWS = 2, 3  # from the posterior, for what is made of the outcome
# Of few keyframes more free ones: the degrees of freedom that they show are off by sqrt(2 spent / draws), of few
# residuals too much. So many keyframes times draws at most; doubled, they cost twice as much, and are off by 0.7 times
# as much.
DRAWS_TIMES_KEYFRAMES, MAX_JOINT_DRAWS = 640, 64
N_MORE_CHAIN_DRAWS = 5  # for where these leave doubt; drawn later, so that the first stay what they are


@dataclass(frozen=True)
class Step:
    """One iteration: half the robust chi^2 before it, the decrease that the linear model promises, and its fate."""

    cost: float
    predicted_decrease: float
    damping: float
    accepted: bool


@dataclass(frozen=True)
class Visit:
    """Where the solver stood when it looked for a step: the state, and the calibration parameters' information (B, B)
    there, the chain marginalised (damping included)."""

    state: State
    information: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """Where the solver ended, with a status that is a sentence. problem: the one that was solved, points of the scene
    looked for where they were; information (B, B): of the calibration parameters at `state`, the chain marginalised, no
    damping; empty, and no draws, where another pass follows. stopped_early: left before its end, because more seemed of
    no use. room: the pieces that it was solved in, to be filled anew; None without features, of which alone the fronts
    are kept."""

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
    room: tuple[Piece, ...] | None = None


@dataclass(frozen=True)
class Draws:
    """Steps drawn from the posterior: `free` ones, undetermined directions of the calibration parameters held, and
    `still` ones, all of the calibration parameters held."""

    free: tuple[Draw, ...]
    still: tuple[Draw, ...]

    @classmethod
    def of(cls, solution: Solution) -> Draws:
        """From what was solved last, the pieces as the solve left them."""
        rng, factors = np.random.default_rng(0), solution.factors
        drawn = factors.draws(rng, N_JOINT_DRAWS, N_CHAIN_DRAWS) + factors.draws(rng, 0, N_MORE_CHAIN_DRAWS)
        more = min(DRAWS_TIMES_KEYFRAMES // len(solution.chain), MAX_JOINT_DRAWS) - N_JOINT_DRAWS
        free = drawn[:N_JOINT_DRAWS] + (factors.draws(rng, more, 0) if more > 0 else ())
        return cls(free, drawn[N_JOINT_DRAWS:])


def relative_decrease(steps: Sequence[Step], cost: float) -> float:
    """From where the first of `steps` began to half a chi^2 of `cost`, as a share of that; nothing where that is
    nothing, or there is no step."""
    return steps[0].cost / cost - 1.0 if steps and cost > 0.0 else 0.0


def outcome_of(
    problem: Problem,
    state: State,
    cost: float,
    residuals: Residuals,
    left: float,
    steps: list[Step],
    end: Solution | None = None,
) -> Outcome:
    """The outcome at `state`. `left`: what half the chi^2 can still fall by; `end`: what was solved there."""
    converged, n = left < STALLED_DECREASE, len(steps)
    # Half a chi^2 of d is a step of sqrt(2 d) standard deviations at most.
    share = max(100.0 * np.sqrt(2.0 * max(left, 0.0)), 1.0)
    status = (
        f"converged in {n} iteration{'s' * (n != 1)} of the last pass: the next step would move no parameter by more "
        f"than {share:.0f} % of its standard deviation."
        if converged
        else (
            f"not converged after {n} iterations: the next step would still lower half the chi^2 of {cost:.6g} by "
            f"{left:.3g}; give a better initial guess, or check the noise in the rig file."
        )
    )
    begun = Outcome(problem, state, cost, residuals, NO_DIRECTIONS, tuple(steps), converged, status)
    if end is None:
        return begun
    pieces = end.factors.pieces
    room = pieces if any(p.features is not None for p in pieces) else None
    return replace(begun, information=end.information, draws=Draws.of(end), room=room)


def posterior(problem: Problem, state: State) -> Draws:
    """Draws from the posterior at `state`. Raises NotDefiniteError."""
    pieces = problem.pieces()
    problem.linearise(state, pieces, problem.residuals(), curved=True)
    return Draws.of(solve(pieces, problem.n_keyframes, problem.tolerance, fixed_directions=problem.fixed_directions))
