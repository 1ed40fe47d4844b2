"""How much of the information on lasting parameters is only noise in the Jacobians.

A Jacobian that is taken at a noisy trajectory and noisy readings shows motion that was not there: where the truth is no
information at all, J^T J shows some, which grows with the square of the noise. What noise adds is measured by adding
it once more: S(x + d) - S(x), its mean over draws +-d of the trajectory's own posterior and of the IMU's noise.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from icalib.estimation.arrowhead import HELD_BELOW, Piece, solve
from icalib.estimation.imu_data import ImuData
from icalib.estimation.imu_factor import ImuFactor
from icalib.estimation.problem import Problem
from icalib.estimation.solver import Outcome, posterior
from icalib.estimation.state import State

CLEAR = 10.0  # information in tolerance units: where all is known to a third of a tolerance, one pair will do
SLIGHT = 0.05  # of the information: where one pair finds less noise than this, it will do, too


def spurious_information(problem: Problem, outcome: Outcome, seed: int = 0) -> np.ndarray:
    """(B, B) what noise adds to the border's marginal information, on average; zeros where there is no IMU.

    Raises arrowhead.NotDefiniteError where the chain is not determined.
    """
    if not isinstance(problem.chain, ImuFactor):
        return np.zeros_like(outcome.information)
    rng = np.random.default_rng(seed)
    t = problem.tolerance
    scaled = t[:, None] * outcome.information * t
    clear = np.linalg.eigvalsh(scaled).min(initial=np.inf) > CLEAR
    samples = (outcome.draws or posterior(problem, outcome.state)).still
    found, room = [], problem.room()
    for sample in samples[:1] if clear else samples:
        imu = _reading_noise(problem.chain.imu, rng)
        for sign in (1.0, -1.0):
            found.append(_information(*_moved(problem, outcome.state, sign * sample.chain, sign * imu), room))
        noise = np.mean(found, axis=0) - outcome.information
        if _largest_share(t[:, None] * noise * t, scaled) < SLIGHT:
            break
    return np.mean(found, axis=0) - outcome.information


def _largest_share(noise: np.ndarray, information: np.ndarray) -> float:
    """Of what is noise, in absolute value, in any direction that the solver moves along; both in tolerance units."""
    values, vectors = np.linalg.eigh(information)
    known = values > HELD_BELOW
    half = vectors[:, known] / np.sqrt(values[known])
    return float(np.abs(np.linalg.eigvalsh(half.T @ noise @ half)).max(initial=0.0))


def _information(problem: Problem, state: State, room: tuple[Piece, ...] | None) -> np.ndarray:
    if room is None:
        n = problem.layout.size
        return problem.marginal(partial(problem.sums_of, state))[:n, :n]
    problem.linearise(state, room, problem.residuals(), curved=True)
    return solve(room, problem.n_nodes, problem.tolerance).information


def _reading_noise(imu: ImuData, rng: np.random.Generator) -> np.ndarray:
    """(N, 6) noise of the readings, rate and force, as their densities say; none more beside gaps."""
    dt = np.median(np.diff(imu.seconds))
    density = np.repeat(np.sqrt(np.median(imu.variance[:, :2], axis=0)), 3)
    return density / np.sqrt(dt) * rng.standard_normal((len(imu.seconds), 6))


def _moved(problem: Problem, state: State, chain: np.ndarray, readings: np.ndarray) -> tuple[Problem, State]:
    """The problem with noisier readings, and the state with its chain moved."""
    assert isinstance(problem.chain, ImuFactor)
    state = state.retract(problem.layout, chain, np.zeros(problem.layout.size))
    old = problem.chain.imu
    imu = replace(old, gyro=old.gyro + readings[:, :3], accel=old.accel + readings[:, 3:])
    factor = ImuFactor.build(imu, state, problem.chain.gravity, problem.chain.columns)
    cameras = tuple(replace(c, imu=imu) for c in problem.cameras)
    features = None if problem.features is None else replace(problem.features, cameras=cameras)
    sensors = tuple(s.with_imu(imu) for s in problem.sensors)
    return replace(problem, chain=factor, cameras=cameras, features=features, sensors=sensors), state
