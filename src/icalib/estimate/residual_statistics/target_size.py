"""How large the target is to everything but the ruler that it was measured with: above all to the accelerometer.

Cameras alone see a target of any size. Its size is no parameter of the estimate, because accelerometers know it to a
few per cent only, a ruler to a tenth of one. As one more parameter, s, it would be where the least cost over all
others, p(s), is least. All lengths that cameras see grow with the target, which costs the cameras nothing; p(s) is the
cost there, less what one step takes off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from icalib.estimate.problem.problem import Problem
from icalib.estimate.problem.solver import minimise
from icalib.model.target_factor import TargetFactor
from icalib.motion.factor import Residuals, of_type
from icalib.optim.arrowhead import Piece, solve
from icalib.optim.state import State
from icalib.sensors.imu.residual import ImuFactor

SIZE_STEP = 1e-3  # of the size: small against what bends p, large against rounding
MAX_SIZE_SIGMA = 0.05  # a size that is known no better is not known
MAX_SIZE_CHANGE = 5e-3  # what one step about the state is good for
MAX_SIZE_ROUNDS = 3
INNER_TOLERANCE = 0.5  # of half the chi^2, of the states in between


@dataclass(frozen=True)
class TargetSize:
    """True size over the one given, and its formal standard deviation."""

    ratio: float
    std: float


def target_size(problem: Problem, state: State) -> TargetSize | None:
    """By all that was measured, from where the solver ended; None where nothing but cameras shows a size, or there is
    no target."""
    seen = any(f.sees_target for f in of_type(problem.factors, TargetFactor))
    if not seen or not problem.framed or not isinstance(problem.chain, ImuFactor):
        return None
    ratio = std = 1.0
    room = problem.pieces(), problem.residuals()
    for _ in range(MAX_SIZE_ROUNDS):
        costs = [
            _least_cost(*_grown(problem, state, ratio, ratio + step), *room) for step in (-SIZE_STEP, 0.0, SIZE_STEP)
        ]
        slope, curvature = (
            (costs[2] - costs[0]) / (2.0 * SIZE_STEP),
            (costs[2] - 2.0 * costs[1] + costs[0]) / SIZE_STEP**2,
        )
        if curvature * MAX_SIZE_SIGMA**2 < 1.0:
            return None
        change, std = -slope / curvature, curvature**-0.5
        grown, begin = _grown(problem, state, ratio, ratio + change)
        ratio += change
        if abs(change) < MAX_SIZE_CHANGE:
            break
        state = minimise(grown, begin, tolerance=INNER_TOLERANCE).state
    return TargetSize(float(ratio), float(std))


def _grown(problem: Problem, state: State, now: float, size: float) -> tuple[Problem, State]:
    """The same problem with a target `size` times as large, and all that cameras see grown with it from where it was
    `now`, but for lengths that are fixed."""
    factors, by = tuple(f.with_target_size(size) for f in of_type(problem.factors, TargetFactor)), size / now
    bodies = factors[0].bodies
    lengths = {(f.name, "translation") for f in factors} | {(b, "shape") for b in bodies.bending}
    lengths |= {(b, "translation") for b in bodies.names if bodies.several}
    lengths &= {b.key for b in problem.layout.free}
    values = {key: by * v if key in lengths else v for key, v in state.values.items()}
    begin = replace(state, position=by * state.position, velocity=by * state.velocity, values=values)
    return problem.replacing(factors), begin


def _least_cost(problem: Problem, state: State, pieces: tuple[Piece, ...], scratch: Residuals) -> float:
    """Half the robust chi^2, the least over all parameters."""
    cost = problem.linearise(state, pieces, scratch, curved=True)
    return (
        cost - solve(pieces, problem.n_keyframes, problem.tolerance, fixed_directions=problem.fixed_directions).decrease
    )
