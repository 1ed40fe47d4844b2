"""Size of the target according to all measurements but the ruler, above all those of the accelerometer.

Cameras alone cannot determine the size. It is not estimated, because accelerometers determine it to a few per cent
only, a ruler to 0.1 %. Here it is the minimum of the profile cost p(s), the least cost over all other parameters for
the relative size s. All lengths that cameras observe scale with the target, which leaves the cost of the cameras
unchanged. p(s) is the cost after this scaling, less the decrease that one step predicts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from icalib.estimate.problem.problem import Problem
from icalib.estimate.problem.solver import minimise
from icalib.estimate.problem.solver_options import SolverOptions
from icalib.model.target_factor import TargetFactor
from icalib.motion.factor import Residuals, of_type
from icalib.optim.arrowhead import Piece
from icalib.optim.state import State

SIZE_STEP = 1e-3  # relative step of difference quotients: small enough for p to be quadratic, large against rounding
MAX_SIZE_SIGMA = 0.05  # relative: with a larger standard deviation the size is unobservable
MAX_SIZE_CHANGE = 5e-3  # relative: a larger change needs another round at a new state
MAX_SIZE_ROUNDS = 3
INNER_TOLERANCE = 0.5  # of half the chi^2, for the state of the next round


@dataclass(frozen=True)
class TargetSize:
    """Ratio of true to stated size, and its formal standard deviation."""

    ratio: float
    std: float


def target_size(problem: Problem, state: State) -> TargetSize | None:
    """True over stated size of the target by the accelerometer, with its standard deviation. None without a target or
    an IMU, or if the size is unobservable. state: the solution with the stated size."""
    sees_target = any(f.sees_target for f in of_type(problem.factors, TargetFactor))
    if not sees_target or not problem.framed or problem.chain.imu is None:
        return None
    ratio = std = 1.0
    workspace = problem.pieces(), {key: f.discarded_output() for key, f in problem.factors.items()}
    for _ in range(MAX_SIZE_ROUNDS):
        sizes = (ratio - SIZE_STEP, ratio, ratio + SIZE_STEP)
        costs = [_least_cost(*_grown(problem, state, ratio, size), *workspace) for size in sizes]
        slope = (costs[2] - costs[0]) / (2.0 * SIZE_STEP)
        curvature = (costs[2] - 2.0 * costs[1] + costs[0]) / SIZE_STEP**2
        if curvature * MAX_SIZE_SIGMA**2 < 1.0:
            return None
        change, std = -slope / curvature, curvature**-0.5
        grown, begin = _grown(problem, state, ratio, ratio + change)
        ratio += change
        if abs(change) < MAX_SIZE_CHANGE:
            break
        state = minimise(grown, begin, SolverOptions(INNER_TOLERANCE)).state
    return TargetSize(float(ratio), float(std))


def _grown(problem: Problem, state: State, old_size: float, size: float) -> tuple[Problem, State]:
    """The problem with a target `size` times the stated one, and the state with all lengths that cameras observe scaled
    by size / old_size. Fixed lengths are not scaled."""
    factors, scale = tuple(f.with_target_size(size) for f in of_type(problem.factors, TargetFactor)), size / old_size
    bodies = factors[0].bodies
    lengths = {(f.name, "translation") for f in factors} | {(b, "shape") for b in bodies.bending}
    lengths |= {(b, "translation") for b in bodies.names if bodies.several}
    lengths &= {b.key for b in problem.layout.free}
    values = {key: scale * v if key in lengths else v for key, v in state.values.items()}
    begin = replace(state, position=scale * state.position, velocity=scale * state.velocity, values=values)
    return problem.replacing(factors), begin


def _least_cost(problem: Problem, state: State, pieces: tuple[Piece, ...], scratch: Residuals) -> float:
    """Approximate minimum over all parameters of half the robust chi^2: its value at `state`, less the decrease that
    one Newton step predicts. Overwrites `pieces` and `scratch`."""
    cost = problem.linearise(state, pieces, scratch, curved=True)
    return cost - problem.solve(pieces).decrease
