"""Unobservable directions: the prior mean at which they are fixed, and the consider covariance of all other parameters.

A fixed direction has the value of the guesses of all parameters that it moves. Independent errors of these guesses give
the prior covariance of the fixed directions. Each principal axis is moved by one standard deviation, and all other
parameters are solved again. Their shift is the sensitivity to the fixed directions.
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

# information in tolerance units, noise in the Jacobian included; below it a direction is reset to the guess
PULLED = 0.25
FARTHEST = 2.0  # standard deviations of the guess; a direction farther from the guess is reset to it
MOVED_BY_HELD = 0.1  # entry of a unit direction above which the direction moves that parameter
MOSTLY = 0.5  # share of the squared length of a direction
NEAR_GUESS = 0.05  # of the prior uncertainty of the guess; a shorter reset is skipped
TOGETHER = 4  # random sign combinations of the errors of the guess, to sample how far their effects are not additive
HALVINGS = 4  # most halvings of a move that is too long to be solved


def astray(
    inputs: Inputs, problem: Problem, state: State, guess: State, open_: np.ndarray, asked: np.ndarray
) -> np.ndarray:
    """(B, k) orthonormal directions in the span of `open_` (B, m) along which `state` is to be reset to `guess`.

    A direction is left where it is if two things hold. Its information `asked` (B, B; tolerance units, noise in the
    Jacobian included) exceeds PULLED, and `state` is within FARTHEST prior standard deviations of the guess. Noise in
    the Jacobian biases towards values where it is smallest, such as a zero lever arm. But it can also hide weak data,
    and a reset to a wrong guess would then distort well-known parameters.
    """
    if not open_.size:
        return open_
    values, turn = np.linalg.eigh(open_.T @ asked @ open_)
    axes = open_ @ turn
    way = axes.T @ (calib_difference(problem, guess, state) / problem.tolerance)
    worth = np.sqrt(np.diag(_guess_covariance(inputs, problem, state, axes)))
    return axes[:, (values < PULLED) | (np.abs(way) > FARTHEST * worth)]


def moved_to_guess(problem: Problem, state: State, guess: State, fixed_directions: np.ndarray) -> State:
    """`state` with its components along `fixed_directions` (B, m) set to those of `guess` (orthogonal projection)."""
    way = calib_difference(problem, guess, state) / problem.tolerance
    return _moved(problem, state, fixed_directions @ (fixed_directions.T @ way))


def moved_to_worth(
    inputs: Inputs, problem: Problem, state: State, guess: State, fixed_directions: np.ndarray
) -> State | None:
    """`state`, reset along `fixed_directions` (B, m) to the mean of the priors of all parameters in them, by weighted
    least squares. None if the rig file has no prior on them, or if the state is there already.

    Example: the data show only the difference of two heights, and one height was measured. `moved_to_guess` would
    change both heights by half.
    """
    if not _is_weighed(inputs, fixed_directions):
        return None
    sigma, way = _weights(inputs, state), calib_difference(problem, guess, state)
    # Parameters without a guess may move along, but their own difference from the guess must not cause a move.
    for block in _unguessed(inputs):
        way[block.columns] = 0.0
    directions = problem.tolerance[:, None] * fixed_directions
    step = directions @ np.linalg.lstsq(directions / sigma[:, None], way / sigma, rcond=None)[0]
    if np.linalg.norm(step / sigma) < NEAR_GUESS:
        return None
    return _moved(problem, state, step / problem.tolerance)


def owed_to_guess(inputs: Inputs, outcome: Outcome, data: np.ndarray) -> np.ndarray:
    """(n, B) changes of the calibration parameters, in their units, for errors of the guess along the m fixed
    directions.

    The first m rows are those of the independent errors, one standard deviation each. At most TOGETHER more rows hold
    the deviation of random sign combinations from the sum. The outer products of all rows add up to the consider
    covariance. data (B, B): information of the data alone, in tolerance units. Uses the workspace of `outcome`.
    """
    problem = outcome.problem
    ways = _ways(inputs, outcome, data)
    if _leave_nothing(inputs, problem, ways):
        return in_proportion(inputs, outcome, data)
    alone = np.array([_answer(outcome, way) for way in ways.T])
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (TOGETHER, ways.shape[1]))
    # With few errors the sign combinations repeat: each is solved once and weighted by its count.
    own, times = np.unique(signs, axis=0, return_counts=True)
    beyond = np.array([_answer(outcome, ways @ s) - s @ alone for s in own])
    return np.vstack([alone, np.sqrt(times / TOGETHER)[:, None] * beyond])


def in_proportion(inputs: Inputs, outcome: Outcome, data: np.ndarray) -> np.ndarray:
    """(m, B) as `owed_to_guess`, but only the fixed directions themselves move: nothing is solved."""
    return outcome.problem.tolerance * _ways(inputs, outcome, data).T


def _ways(inputs: Inputs, outcome: Outcome, data: np.ndarray) -> np.ndarray:
    """(B, m) independent errors of the guess along the fixed directions, one standard deviation each, in tolerance
    units.

    Directions mostly of walls, boards and frames, which have no guess, are limited to the standard deviation that the
    information `data` (B, B) allows. Unlimited, a board would be rotated by any angle against gravity, with an absurd
    accelerometer bias.
    """
    problem = outcome.problem
    # NumPy's divide and conquer has failed on many nearly equal eigenvalues.
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
    """(m, m) prior covariance of the guess along `fixed_directions` (B, m), in tolerance units.

    With V = `fixed_directions` and S the diagonal matrix of the prior variances, it is (V^T S^-1 V)^-1 if the rig file
    has priors there. The state is then reset by weighted least squares (`moved_to_worth`). Without priors it is V^T S
    V, and the reset is an orthogonal projection (`moved_to_guess`).
    """
    if _is_weighed(inputs, fixed_directions):
        scaled = fixed_directions * (problem.tolerance / _weights(inputs, state))[:, None]
        return np.linalg.inv(scaled.T @ scaled)
    sigma = guess_sigma(inputs, state)
    for block in _unguessed(inputs):
        sigma[block.columns] = np.minimum(sigma[block.columns], UNGUESSED_SIGMA)
    scaled = fixed_directions * (sigma / problem.tolerance)[:, None]
    return scaled.T @ scaled


def _leave_nothing(inputs: Inputs, problem: Problem, ways: np.ndarray) -> bool:
    """Whether errors of the guess alone make every parameter of every sensor unobservable."""
    owed = (ways**2).sum(axis=1)
    return all(
        (owed[b.columns] > 1.0 / UNOBSERVABLE_BELOW).all() for b in problem.layout.free if inputs.is_sensor(b.sensor)
    )


def _answer(outcome: Outcome, way: np.ndarray) -> np.ndarray:
    """(B,) change of the calibration parameters, in their units, if the guess moves by `way` (B,; tolerance units)
    along the fixed directions. If that move is too long to be solved, a shorter one is solved and scaled up."""
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
    """Whether the rig file has a prior on a parameter that `fixed_directions` (B, m) move."""
    own = np.concatenate([np.empty(0, dtype=np.int64), *(p.block.columns for p in given_priors(inputs))])
    return bool(fixed_directions.size and np.any(np.abs(fixed_directions[own]) > MOVED_BY_HELD))


def _weights(inputs: Inputs, state: State) -> np.ndarray:
    """(B,) prior standard deviations of the guess, in parameter units. Rotations, tilts and normals of walls, boards
    and frames get the default of a rotation."""
    sigma = guess_sigma(inputs, state)
    for block in _unguessed(inputs):
        if block.kind not in ("vector", "nuisance"):
            sigma[block.columns[:2] if block.kind == "plane" else block.columns] = ROTATION.prior_sigma
    return sigma


def _unguessed(inputs: Inputs) -> list[Block]:
    """Blocks that belong to no sensor: walls, boards and frames. They have no initial guess."""
    return [b for b in inputs.layout.free if not inputs.is_sensor(b.sensor)]


def _moved(problem: Problem, state: State, way: np.ndarray) -> State:
    """`state` with the calibration parameters moved by `way` (B,), in tolerance units."""
    return state.retract(problem.layout, np.zeros((len(state.seconds), 15)), problem.tolerance * way)


def calib_difference(problem: Problem, a: State, b: State) -> np.ndarray:
    """(B,) step of the calibration parameters that leads from `b` to `a`, in their units."""
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
