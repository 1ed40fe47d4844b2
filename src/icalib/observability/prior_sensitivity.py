"""Unobservable directions: the prior mean at which they are fixed, and the consider covariance of all other parameters.

A fixed direction has the value of the guesses of all parameters that it moves. Independent errors of these guesses give
the prior covariance of the fixed directions. The response of all other parameters is that of the normal equations at
the solution (implicit function theorem). Its derivative gives the second-order terms: on a plane the baseline of wheels
changes with the square of their roll.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from scipy.linalg import eigh

from icalib.estimate.problem.assembly import given_priors
from icalib.estimate.problem.guess_priors import guess_sigma
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.problem.outcome import Outcome
from icalib.estimate.problem.problem import Problem
from icalib.estimate.problem.tolerances import UNGUESSED_SIGMA
from icalib.geometry import planes, so3
from icalib.optim.arrowhead import Factors, NotDefiniteError, solve
from icalib.optim.calib_block import UNOBSERVABLE_BELOW, restricted_inverse
from icalib.optim.state import Block, State
from icalib.sensors.sensor import ROTATION

# information in tolerance units, noise in the Jacobian included; below it a direction is reset to the guess
WEAKLY_CONSTRAINED_BELOW = 0.25
MAX_PRIOR_SIGMAS = 2.0  # standard deviations of the guess; a direction farther from the guess is reset to it
MOVED_ABOVE = 0.1  # entry of a unit direction above which the direction moves that parameter
MIN_RESET = 0.05  # of the prior uncertainty of the guess; a shorter reset is skipped
SHORT_STEP = 0.1  # standard deviations of the guess: half the step of the central differences of the response


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


def prior_sensitivity(inputs: Inputs, outcome: Outcome, data: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(n, B) changes of the calibration parameters, in their units, whose outer products add up to the consider
    covariance of the m fixed directions.

    The first m rows are the linear responses to independent errors of the guess, one standard deviation each. The
    others hold the mean and the covariance of the second-order terms for Gaussian errors (Athans, Wishner and Bertolini
    1968). The sum does not depend on signs and choice of the axes. data, noise (B, B): information of the data alone,
    and what noise in the Jacobian adds, in tolerance units. Overwrites the workspace of `outcome`. A failed estimate,
    or one with no other direction, has no response: only the fixed directions themselves move.
    """
    problem, state = outcome.problem, outcome.state
    errors = _guess_errors(inputs, outcome, data)
    m, is_usable = errors.shape[1], outcome.converged or outcome.stopped_early
    if not is_usable or m == len(problem.layout.essential):
        return problem.tolerance * errors.T
    factors = _factors(outcome, state)
    first, second = _response(factors, noise, errors), np.zeros((m, len(errors), m))
    chain = factors.back(np.vstack([first, np.zeros((1, m))]), [np.zeros((n, m)) for n in factors.rows()])
    for k in range(m):
        step = SHORT_STEP * np.ascontiguousarray(chain[:, :, k]), SHORT_STEP * first[:, k]
        ends = (state.retract(problem.layout, sign * step[0], sign * step[1]) for sign in (1.0, -1.0))
        with suppress(NotDefiniteError):  # no second-order terms where even a short step is too long
            up, down = (_response(_factors(outcome, end), noise, errors) for end in ends)
            second[k] = (up - down) / (2.0 * SHORT_STEP)
    second = 0.5 * (second + second.transpose(2, 1, 0))
    return np.vstack([first.T, 0.5 * np.einsum("kbk->b", second), *np.sqrt(0.5) * second.transpose(0, 2, 1)])


def _factors(outcome: Outcome, state: State) -> Factors:
    """The factorised normal equations of `outcome` at `state`; overwrites its workspace."""
    problem, pieces = outcome.problem, outcome.workspace or outcome.problem.pieces()
    problem.linearise(state, pieces, problem.residuals(), curved=True)
    return solve(pieces, problem.n_keyframes, problem.tolerance, fixed_directions=problem.fixed_directions).factors


def _response(factors: Factors, noise: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """(B, m) change of all calibration parameters, in their units, with `errors` (B, m) along the fixed directions, by
    the implicit function theorem. noise (B, B): information that noise in the Jacobian adds; both in tolerance
    units."""
    t = factors.tolerance[:, None]
    known = t * factors.information * t.T - noise
    return t * (errors - restricted_inverse(known, factors.fixed_directions) @ (known @ errors))


def _guess_errors(inputs: Inputs, outcome: Outcome, data: np.ndarray) -> np.ndarray:
    """(B, m) independent errors of the guess along the fixed directions, one standard deviation each, in tolerance
    units.

    Walls, boards and frames have no guess. The more a direction consists of them, the more the information `data` (B,
    B) limits its standard deviation. Unlimited, a board would be rotated by any angle against gravity, with an absurd
    accelerometer bias.
    """
    problem, fixed_directions = outcome.problem, outcome.problem.fixed_directions
    of_sensors = [b.columns for b in problem.layout.free if inputs.is_sensor(b.sensor)]
    unguessed = np.delete(fixed_directions, np.concatenate([np.arange(0), *of_sensors]), axis=0)
    share = _root(unguessed.T @ unguessed, 1.0)
    limit = _root(fixed_directions.T @ data @ fixed_directions, UNOBSERVABLE_BELOW) @ share
    root = _root(_prior_covariance(inputs, problem, outcome.state, fixed_directions), np.inf)
    limited = np.linalg.inv(np.eye(len(root)) + root @ limit.T @ limit @ root)
    return fixed_directions @ root @ _root(limited, 1.0)


def _root(covariance: np.ndarray, largest: float) -> np.ndarray:
    """(m, m) symmetric root of `covariance` (m, m), whose eigenvalues are clipped to 0 and `largest`."""
    # NumPy's divide and conquer has failed on many nearly equal eigenvalues.
    values, vectors = eigh(covariance, driver="evr")
    return vectors * np.sqrt(np.clip(values, 0.0, largest)) @ vectors.T


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
