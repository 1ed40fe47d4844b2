"""Unobservable directions: the prior mean that they are fixed at, and the consider covariance of everything else.

A fixed direction has the value of the guesses of all parameters that it moves. Independent errors of these guesses give
its prior covariance. Each principal axis is moved by one standard deviation and everything else is solved again; the
shift of the other parameters is their sensitivity to the fixed ones.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh

from icalib.errors import EstimationError
from icalib.estimate.estimate import EARLY_DECREASE
from icalib.estimate.problem.assembly import given_priors
from icalib.estimate.problem.guess_priors import guess_sigma
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.problem.outcome import Outcome
from icalib.estimate.problem.problem import Problem
from icalib.estimate.problem.solver import minimise
from icalib.estimate.problem.tolerances import UNGUESSED_SIGMA
from icalib.geometry import planes, so3
from icalib.optim.calib_block import UNOBSERVABLE_BELOW
from icalib.optim.state import Block, State
from icalib.sensors.sensor import ROTATION

PULLED = 0.25  # information in tolerance units, noise and all
FARTHEST = 2.0  # standard deviations of the guess
MOVED_BY_HELD = 0.1  # parts of a direction smaller than this do not count as in it
MOSTLY = 0.5  # of the square of a direction
NEAR_GUESS = 0.05  # of the prior uncertainty of the guess
TOGETHER = 4  # ways in which errors of the guess come together: what one makes beyond the sum is little by chance
HALVINGS = 4  # of a move along which nothing can be solved


def astray(
    inputs: Inputs, problem: Problem, state: State, guess: State, open_: np.ndarray, asked: np.ndarray
) -> np.ndarray:
    """(B, k) orthonormal directions in the span of `open_` (B, m) along which `state` is to move to `guess`: all but
    those along which the measurements pull, be it by noise, to a place as near the guess as the truth may be.

    asked (B, B): information in tolerance units, with what noise adds to it. Noise pulls to where it shows least, such
    as a lever arm of nothing; but where it hides what little the data know, a guess far from there would be paid for
    by all that is well known.
    """
    if not open_.size:
        return open_
    values, turn = np.linalg.eigh(open_.T @ asked @ open_)
    axes = open_ @ turn
    way = axes.T @ (calib_difference(problem, guess, state) / problem.tolerance)
    worth = np.sqrt(np.diag(_guess_covariance(inputs, problem, state, axes)))
    return axes[:, (values < PULLED) | (np.abs(way) > FARTHEST * worth)]


def moved_to_guess(problem: Problem, state: State, guess: State, fixed_directions: np.ndarray) -> State:
    """`state`, moved along the directions `fixed_directions` (B, m) to where `guess` has them."""
    way = calib_difference(problem, guess, state) / problem.tolerance
    return _moved(problem, state, fixed_directions @ (fixed_directions.T @ way))


def moved_to_worth(
    inputs: Inputs, problem: Problem, state: State, guess: State, fixed_directions: np.ndarray
) -> State | None:
    """`state`, reset along the directions `fixed_directions` (B, m) to the prior mean of all parameters that they move,
    weighted by their prior uncertainty; None where the rig file has no priors among them, or the state is there
    already.

    Where the data know only how two heights differ, and one was measured, `moved_to_guess` would leave both half-way.
    """
    if not _is_weighed(inputs, fixed_directions):
        return None
    sigma, way = _weights(inputs, state), calib_difference(problem, guess, state)
    # What nobody guessed moves along, but nothing turns: what little a turn moves would be paid for with all of it.
    for block in _unguessed(inputs):
        way[block.columns] = 0.0
    directions = problem.tolerance[:, None] * fixed_directions
    step = directions @ np.linalg.lstsq(directions / sigma[:, None], way / sigma, rcond=None)[0]
    if np.linalg.norm(step / sigma) < NEAR_GUESS:
        return None
    return _moved(problem, state, step / problem.tolerance)


def owed_to_guess(inputs: Inputs, outcome: Outcome, data: np.ndarray) -> np.ndarray:
    """(m + TOGETHER or fewer, B) how the calibration parameters move with each of m independent errors of the guess
    along the fixed directions, one standard deviation each, and by how much more or less all of them move it
    together.

    data (B, B): information of the data alone, in tolerance units. The room of `outcome` is used.
    """
    problem = outcome.problem
    ways = _ways(inputs, outcome, data)
    if _leave_nothing(inputs, problem, ways):
        return in_proportion(inputs, outcome, data)
    alone = np.array([_answer(outcome, way) for way in ways.T])
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (TOGETHER, ways.shape[1]))
    # Of few errors the signs repeat: each combination is solved once.
    own, times = np.unique(signs, axis=0, return_counts=True)
    beyond = np.array([_answer(outcome, ways @ s) - s @ alone for s in own])
    return np.vstack([alone, np.sqrt(times / TOGETHER)[:, None] * beyond])


def in_proportion(inputs: Inputs, outcome: Outcome, data: np.ndarray) -> np.ndarray:
    """(m, B) as `owed_to_guess`, if only the fixed directions move."""
    return outcome.problem.tolerance * _ways(inputs, outcome, data).T


def _ways(inputs: Inputs, outcome: Outcome, data: np.ndarray) -> np.ndarray:
    """(B, m) in tolerance units: errors of the guess along fixed directions, independent, one standard deviation each.

    An error mostly of parameters that nobody guessed is no larger than the information `data` (B, B) allows: a board
    turned against gravity by as much as it likes would be turned round and round, with a bias of the accelerometer that
    nobody believes."""
    problem = outcome.problem
    # Of so many like variances divide and conquer, NumPy's way, has failed to find the eigenvectors.
    values, turn = eigh(_guess_covariance(inputs, problem, outcome.state, problem.fixed_directions), driver="evr")
    ways = problem.fixed_directions @ turn
    width = np.sqrt(np.clip(values, 0.0, None))
    own = np.concatenate([np.arange(0), *(b.columns for b in problem.layout.free if inputs.is_sensor(b.sensor))])
    for k, way in enumerate(ways.T):
        left = float(np.clip(way @ data @ way, 0.0, UNOBSERVABLE_BELOW))
        if float((way[own] ** 2).sum()) < MOSTLY and width[k] ** 2 * left > 1.0:
            width[k] = 1.0 / np.sqrt(left)
    return ways * width


def _guess_covariance(inputs: Inputs, problem: Problem, state: State, fixed_directions: np.ndarray) -> np.ndarray:
    """(m, m) of the guess along directions `fixed_directions` (B, m), in tolerance units: of an orthogonal projection,
    as `moved_to_guess` makes it, or of a weighted one, as `moved_to_worth` does."""
    if _is_weighed(inputs, fixed_directions):
        scaled = fixed_directions * (problem.tolerance / _weights(inputs, state))[:, None]
        return np.linalg.inv(scaled.T @ scaled)
    sigma = guess_sigma(inputs, state)
    for block in _unguessed(inputs):
        sigma[block.columns] = np.minimum(sigma[block.columns], UNGUESSED_SIGMA)
    scaled = fixed_directions * (sigma / problem.tolerance)[:, None]
    return scaled.T @ scaled


def _leave_nothing(inputs: Inputs, problem: Problem, ways: np.ndarray) -> bool:
    """Whether the guess alone leaves every parameter of every sensor open."""
    owed = (ways**2).sum(axis=1)
    return all(
        (owed[b.columns] > 1.0 / UNOBSERVABLE_BELOW).all() for b in problem.layout.free if inputs.is_sensor(b.sensor)
    )


def _answer(outcome: Outcome, way: np.ndarray) -> np.ndarray:
    """(B,) shift of the calibration parameters when the guess moves along the fixed direction `way` (B,). If that is
    too far for a solution, a shorter move is scaled up."""
    problem, state = outcome.problem, outcome.state
    for k in range(HALVINGS):
        moved = _moved(problem, state, way / 2**k)
        try:
            there = minimise(problem, moved, tolerance=EARLY_DECREASE, room=outcome.room)
        except EstimationError:
            continue
        return 2**k * calib_difference(problem, there.state, state)
    return problem.tolerance * way


def _is_weighed(inputs: Inputs, fixed_directions: np.ndarray) -> bool:
    """Whether the rig file has a prior on a parameter that the fixed directions `fixed_directions` (B, m) move."""
    own = np.concatenate([np.empty(0, dtype=np.int64), *(p.block.columns for p in given_priors(inputs))])
    return bool(fixed_directions.size and np.any(np.abs(fixed_directions[own]) > MOVED_BY_HELD))


def _weights(inputs: Inputs, state: State) -> np.ndarray:
    """(B,) prior uncertainties of the guess; parameters that nobody guessed do not count, except rotations."""
    sigma = guess_sigma(inputs, state)
    for block in _unguessed(inputs):
        if block.kind not in ("vector", "nuisance"):
            sigma[block.columns[:2] if block.kind == "plane" else block.columns] = ROTATION.prior_sigma
    return sigma


def _unguessed(inputs: Inputs) -> list[Block]:
    """Of no sensor: walls, boards and frames, of which nobody guessed where they are."""
    return [b for b in inputs.layout.free if not inputs.is_sensor(b.sensor)]


def _moved(problem: Problem, state: State, way: np.ndarray) -> State:
    """`state` with the calibration parameters moved by `way` (B,), in tolerance units."""
    return state.retract(problem.layout, np.zeros((len(state.seconds), 15)), problem.tolerance * way)


def calib_difference(problem: Problem, a: State, b: State) -> np.ndarray:
    """(B,) the step of the calibration parameters from `b` to `a`."""
    out = np.zeros(problem.layout.size)
    for block in problem.layout.free:
        x, y = a.values[block.key], b.values[block.key]
        if block.kind == "rotation":
            out[block.columns] = so3.log(np.ascontiguousarray(y.T @ x))
        elif block.kind == "tilt":
            out[block.columns] = so3.log(np.ascontiguousarray(x @ y.T))[:2]
        elif block.kind == "plane":
            out[block.columns] = planes.difference(x, y)
        else:
            out[block.columns] = x - y
    return out
