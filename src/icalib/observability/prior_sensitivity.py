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
from icalib.estimate.problem.solver_options import SolverOptions
from icalib.estimate.problem.tolerances import UNGUESSED_SIGMA
from icalib.geometry import planes, so3
from icalib.optim.calib_block import UNOBSERVABLE_BELOW
from icalib.optim.state import Block, State
from icalib.sensors.sensor import ROTATION

# information in tolerance units, noise in the Jacobian included; below it a direction is reset to the guess
WEAKLY_CONSTRAINED_BELOW = 0.25
MAX_PRIOR_SIGMAS = 2.0  # standard deviations of the guess; a direction farther from the guess is reset to it
MOVED_ABOVE = 0.1  # entry of a unit direction above which the direction moves that parameter
MAJORITY_SHARE = 0.5  # share of the squared length of a direction
MIN_RESET = 0.05  # of the prior uncertainty of the guess; a shorter reset is skipped
N_SIGN_DRAWS = (
    4  # random sign combinations of the errors of the guess, to sample how far their effects are not additive
)
MAX_HALVINGS = 4  # most halvings of a move that is too long to be solved


def directions_to_reset(
    inputs: Inputs, problem: Problem, state: State, guess: State, null_space: np.ndarray, information: np.ndarray
) -> np.ndarray:
    """(B, k) orthonormal directions in the span of `null_space` (B, m) along which `state` is to be reset to `guess`.

    A direction keeps its estimate if two conditions hold. Its `information` (B, B; tolerance units, noise in the
    Jacobian included) exceeds WEAKLY_CONSTRAINED_BELOW, and `state` is within MAX_PRIOR_SIGMAS prior standard
    deviations of the guess. Noise in the Jacobian biases towards values where it is smallest, such as a zero lever arm.
    But it can also hide weak data, and a reset to a wrong guess would then distort well-known parameters.
    """
    if not null_space.size:
        return null_space
    values, turn = np.linalg.eigh(null_space.T @ information @ null_space)
    axes = null_space @ turn
    to_guess = axes.T @ (calib_difference(problem, guess, state) / problem.tolerance)
    prior_sigma = np.sqrt(np.diag(_prior_covariance(inputs, problem, state, axes)))
    return axes[:, (values < WEAKLY_CONSTRAINED_BELOW) | (np.abs(to_guess) > MAX_PRIOR_SIGMAS * prior_sigma)]


def project_to_guess(problem: Problem, state: State, guess: State, fixed_directions: np.ndarray) -> State:
    """`state` with its components along `fixed_directions` (B, m) set to those of `guess` (orthogonal projection)."""
    to_guess = calib_difference(problem, guess, state) / problem.tolerance
    return _moved(problem, state, fixed_directions @ (fixed_directions.T @ to_guess))


def project_to_prior(
    inputs: Inputs, problem: Problem, state: State, guess: State, fixed_directions: np.ndarray
) -> State | None:
    """`state`, reset along `fixed_directions` (B, m) to the mean of the priors of all parameters in them, by weighted
    least squares. None if the rig file has no prior on them, or if the state is at the mean already.

    Example: the data show only the difference of two heights, and one height was measured. `project_to_guess` would
    change both heights by half.
    """
    if not _has_priors(inputs, fixed_directions):
        return None
    sigma, to_guess = _weights(inputs, state), calib_difference(problem, guess, state)
    # Parameters without a guess may move along, but their own difference from the guess must not cause a move.
    for block in _unguessed(inputs):
        to_guess[block.columns] = 0.0
    directions = problem.tolerance[:, None] * fixed_directions
    step = directions @ np.linalg.lstsq(directions / sigma[:, None], to_guess / sigma, rcond=None)[0]
    if np.linalg.norm(step / sigma) < MIN_RESET:
        return None
    return _moved(problem, state, step / problem.tolerance)


def prior_sensitivity(inputs: Inputs, outcome: Outcome, data: np.ndarray) -> np.ndarray:
    """(n, B) changes of the calibration parameters, in their units, for errors of the guess along the m fixed
    directions.

    The first m rows are those of the independent errors, one standard deviation each. At most N_SIGN_DRAWS more rows
    hold the deviation of random sign combinations from the sum. The outer products of all rows add up to the consider
    covariance. data (B, B): information of the data alone, in tolerance units. Uses the workspace of `outcome`.
    """
    errors = _guess_errors(inputs, outcome, data)
    if _make_all_unobservable(inputs, outcome.problem, errors):
        return linear_prior_sensitivity(inputs, outcome, data)
    changes = np.array([_response(outcome, error) for error in errors.T])
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (N_SIGN_DRAWS, errors.shape[1]))
    # With few errors the sign combinations repeat: each is solved once and weighted by its count.
    signs, counts = np.unique(signs, axis=0, return_counts=True)
    deviations = np.array([_response(outcome, errors @ s) - s @ changes for s in signs])
    return np.vstack([changes, np.sqrt(counts / N_SIGN_DRAWS)[:, None] * deviations])


def linear_prior_sensitivity(inputs: Inputs, outcome: Outcome, data: np.ndarray) -> np.ndarray:
    """(m, B) as `prior_sensitivity`, but only the fixed directions themselves move: nothing is solved."""
    return outcome.problem.tolerance * _guess_errors(inputs, outcome, data).T


def _guess_errors(inputs: Inputs, outcome: Outcome, data: np.ndarray) -> np.ndarray:
    """(B, m) independent errors of the guess along the fixed directions, one standard deviation each, in tolerance
    units.

    Directions mostly of walls, boards and frames, which have no guess, are limited to the standard deviation that the
    information `data` (B, B) allows. Unlimited, a board would be rotated by any angle against gravity, with an absurd
    accelerometer bias.
    """
    problem = outcome.problem
    # NumPy's divide and conquer has failed on many nearly equal eigenvalues.
    values, turn = eigh(_prior_covariance(inputs, problem, outcome.state, problem.fixed_directions), driver="evr")
    axes = problem.fixed_directions @ turn
    sigma = np.sqrt(np.clip(values, 0.0, None))
    of_sensors = [b.columns for b in problem.layout.free if inputs.is_sensor(b.sensor)]
    guessed = np.concatenate([np.arange(0), *of_sensors])
    for k, axis in enumerate(axes.T):
        information = float(np.clip(axis @ data @ axis, 0.0, UNOBSERVABLE_BELOW))
        if float((axis[guessed] ** 2).sum()) < MAJORITY_SHARE and sigma[k] ** 2 * information > 1.0:
            sigma[k] = 1.0 / np.sqrt(information)
    return axes * sigma


def _prior_covariance(inputs: Inputs, problem: Problem, state: State, fixed_directions: np.ndarray) -> np.ndarray:
    """(m, m) prior covariance of the guess along `fixed_directions` (B, m), in tolerance units.

    With V = `fixed_directions` and S the diagonal matrix of the prior variances, it is (V^T S^-1 V)^-1 if the rig file
    has priors there. The state is then reset by weighted least squares (`project_to_prior`). Without priors it is V^T S
    V, and the reset is an orthogonal projection (`project_to_guess`).
    """
    if _has_priors(inputs, fixed_directions):
        scaled = fixed_directions * (problem.tolerance / _weights(inputs, state))[:, None]
        return np.linalg.inv(scaled.T @ scaled)
    sigma = guess_sigma(inputs, state)
    for block in _unguessed(inputs):
        sigma[block.columns] = np.minimum(sigma[block.columns], UNGUESSED_SIGMA)
    scaled = fixed_directions * (sigma / problem.tolerance)[:, None]
    return scaled.T @ scaled


def _make_all_unobservable(inputs: Inputs, problem: Problem, errors: np.ndarray) -> bool:
    """Whether the `errors` (B, m) of the guess alone make every parameter of every sensor unobservable."""
    variance = (errors**2).sum(axis=1)
    return all(
        (variance[b.columns] > 1.0 / UNOBSERVABLE_BELOW).all()
        for b in problem.layout.free
        if inputs.is_sensor(b.sensor)
    )


def _response(outcome: Outcome, error: np.ndarray) -> np.ndarray:
    """(B,) change of the calibration parameters, in their units, if the guess moves by `error` (B,; tolerance units)
    along the fixed directions. If that move is too long to be solved, a shorter one is solved and scaled up."""
    problem, state = outcome.problem, outcome.state
    for k in range(MAX_HALVINGS):
        moved = _moved(problem, state, error / 2**k)
        try:
            end = minimise(problem, moved, SolverOptions(EARLY_DECREASE), outcome.workspace)
        except EstimationError:
            continue
        return 2**k * calib_difference(problem, end.state, state)
    return problem.tolerance * error


def _has_priors(inputs: Inputs, fixed_directions: np.ndarray) -> bool:
    """Whether the rig file has a prior on a parameter that `fixed_directions` (B, m) move."""
    columns = np.concatenate([np.empty(0, dtype=np.int64), *(p.block.columns for p in given_priors(inputs))])
    return bool(fixed_directions.size and np.any(np.abs(fixed_directions[columns]) > MOVED_ABOVE))


def _weights(inputs: Inputs, state: State) -> np.ndarray:
    """(B,) prior standard deviations of the guess, in parameter units: those of `guess_sigma`, with one exception.

    Walls, boards and frames have no guess. Their rotations, tilts and normals get the default sigma of a sensor's
    rotation [rad], instead of their own wide default.
    """
    sigma = guess_sigma(inputs, state)
    for block in _unguessed(inputs):
        if block.kind not in ("vector", "nuisance"):
            sigma[block.columns[:2] if block.kind == "plane" else block.columns] = ROTATION.prior_sigma
    return sigma


def _unguessed(inputs: Inputs) -> list[Block]:
    """Blocks that belong to no sensor: walls, boards and frames. They have no initial guess."""
    return [b for b in inputs.layout.free if not inputs.is_sensor(b.sensor)]


def _moved(problem: Problem, state: State, step: np.ndarray) -> State:
    """`state` with the calibration parameters moved by `step` (B,), in tolerance units."""
    return state.retract(problem.layout, np.zeros((len(state.seconds), 15)), problem.tolerance * step)


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
