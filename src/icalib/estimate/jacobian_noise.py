"""Spurious information on the calibration parameters due to noise in the Jacobians (errors in variables).

Jacobians at a noisy trajectory and noisy readings contain motion that did not happen. Even along an unobservable
direction J^T J then has information, which grows with the square of the noise. It is measured by adding noise once
more: the mean of S(x + d) - S(x), with the information S and draws +-d from the posterior of the trajectory and from
the IMU's noise.

The posterior assumes that readings between a keyframe and an image, a sweep or a stamp are exact, yet their noise turns
the trajectory, too. With a noisy IMU this may be as much as the whole posterior contains. So if a first draw shows that
noise matters, the trajectory follows noisier readings as the solver would move it. Their noise that the posterior
already contains is subtracted: S(x + d + u) - S(x + v). Here u is the step with noisier readings in all factors, v with
those in the factors between keyframes alone. Draws are independent and their effect is quadratic, so differences are
valid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import stdtrit

from icalib.estimate.problem import Problem
from icalib.estimate.solver import Outcome, posterior
from icalib.motion.imu_data import ImuData
from icalib.optim.arrowhead import DETERMINED_ABOVE, UNOBSERVABLE_BELOW, Piece, least_information, solve
from icalib.optim.state import State

# information in tolerance units: if all is known to a third of a tolerance, one pair of draws is enough
CLEARLY_DETERMINED = 10.0
# of the information: if all is determined and one sign of a draw shows less, odd terms included, it is enough
NEGLIGIBLE_SHARE = 0.01
SMALL_SHARE = 0.05  # of the information: if one pair of draws shows less, it is enough, too
N_FIRST_DRAWS = 3  # draws before `enough` is asked
CONFIDENCE = 0.999  # probability that spurious information is below its upper bound


@dataclass(frozen=True)
class Spurious:
    """Spurious information on the calibration parameters. each (n, B, B): by draw."""

    each: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """(B, B) mean over the draws."""
        return self.each.mean(axis=0)

    def chance(self, directions: np.ndarray) -> np.ndarray:
        """(m,) upper bound, above the mean, of spurious information in this one recording along directions (B, m). It
        follows from Student's t with probability CONFIDENCE. Zero if one draw was enough."""
        n = len(self.each)
        if n == 1:
            return np.zeros(directions.shape[1])
        along = np.einsum("ik,nij,jk->nk", directions, self.each, directions)
        return float(stdtrit(n - 1, CONFIDENCE)) * np.sqrt(1.0 + 1.0 / n) * along.std(axis=0, ddof=1)


def spurious_information(
    problem: Problem,
    outcome: Outcome,
    enough: Callable[[Spurious], bool] = lambda _: True,
    columns: np.ndarray | None = None,
) -> Spurious:
    """Spurious information on the calibration parameters with these `columns`, by default all; the others are fixed.
    Zeros without an IMU. If noise matters, a few draws are made, and more if these are not `enough`.

    Raises arrowhead.NotDefiniteError if the chain is not determined.
    """
    columns = np.arange(problem.layout.size) if columns is None else columns
    among = np.ix_(columns, columns)
    imu = problem.chain.imu
    if imu is None:
        return Spurious(np.zeros((1, len(columns), len(columns))))
    rng = np.random.default_rng(0)
    t, information = problem.tolerance[columns], outcome.information[among]
    scaled = t[:, None] * information * t
    essential = np.isin(columns, problem.layout.essential)
    least = least_information(information[np.ix_(essential, essential)], t[essential])
    samples = (outcome.draws or posterior(problem, outcome.state)).still
    noise, first = _Noise(problem, outcome, among), _reading_noise(imu, rng)
    one_side = noise.information_change(1.0, samples[0].chain, first)
    if least > DETERMINED_ABOVE and _largest_share(t[:, None] * one_side * t, scaled) < NEGLIGIBLE_SHARE:
        return Spurious(one_side[None])
    both_sides = 0.5 * (one_side + noise.information_change(-1.0, samples[0].chain, first))
    if least > CLEARLY_DETERMINED or _largest_share(t[:, None] * both_sides * t, scaled) < SMALL_SHARE:
        return Spurious(both_sides[None])
    each: list[np.ndarray] = []
    for batch in (samples[1 : 1 + N_FIRST_DRAWS], samples[1 + N_FIRST_DRAWS :]):
        each += [noise.change_with_response(d.chain, _reading_noise(imu, rng)) for d in batch]
        if enough(Spurious(np.array(each))):
            break
    return Spurious(np.array(each))


@dataclass(frozen=True)
class _Noise:
    """Evaluates spurious information at `outcome`, in its workspace. among: index of the columns, as numpy.ix_ returns
    it."""

    problem: Problem
    outcome: Outcome
    among: tuple[np.ndarray, ...]

    def mean_change(self, chain: np.ndarray, readings: np.ndarray | None) -> np.ndarray:
        """Spurious information (B, B) if the trajectory changes by chain (K, D) and the readings by `readings`: mean
        over both signs."""
        return 0.5 * (self.information_change(1.0, chain, readings) + self.information_change(-1.0, chain, readings))

    def information_change(self, sign: float, chain: np.ndarray, readings: np.ndarray | None) -> np.ndarray:
        """Change (B, B) of the information if trajectory and readings change by `sign` times chain (K, D) and
        `readings`. Terms that are odd in the noise are included."""
        noisy_state = self.outcome.state.retract(self.problem.layout, sign * chain, np.zeros(self.problem.layout.size))
        noisy = self.problem if readings is None else _with_noise(self.problem, noisy_state, sign * readings)
        return (_information(noisy, noisy_state, self.outcome.workspace) - self.outcome.information)[self.among]

    def change_with_response(self, chain: np.ndarray, readings: np.ndarray) -> np.ndarray:
        """Spurious information (B, B) if the trajectory follows the noise `readings`, in addition to a posterior draw
        `chain` (K, D). Noise that both contain is counted once."""
        noisy_problem = _with_noise(self.problem, self.outcome.state, readings)
        between_keyframes = self.problem.replacing([noisy_problem.chain])
        return self.mean_change(chain + self._step(noisy_problem), readings) - self.mean_change(
            self._step(between_keyframes), None
        )

    def _step(self, problem: Problem) -> np.ndarray:
        """Solver's step (K, D) of the chain for `problem`, calibration parameters fixed."""
        pieces = self.outcome.workspace or problem.pieces()
        problem.linearise(self.outcome.state, pieces, problem.residuals(), curved=True)
        factors = solve(pieces, problem.n_keyframes, problem.tolerance, essential=problem.layout.essential).factors
        # Zero steps of the calibration parameters, then factor 1 of the gradient, see `Factors.back`.
        calib = np.append(np.zeros(problem.layout.size), 1.0)[:, None]
        return factors.back(calib, [np.zeros((n, 1)) for n in factors.rows()])[:, :, 0]


def _largest_share(noise: np.ndarray, information: np.ndarray) -> float:
    """Largest ratio of |noise| to information over all observable directions; both in tolerance units."""
    values, vectors = np.linalg.eigh(information)
    known = values > UNOBSERVABLE_BELOW
    half = vectors[:, known] / np.sqrt(values[known])
    return float(np.abs(np.linalg.eigvalsh(half.T @ noise @ half)).max(initial=0.0))


def _information(problem: Problem, state: State, workspace: tuple[Piece, ...] | None) -> np.ndarray:
    """Information (B, B) on the calibration parameters at `state`, chain marginalised."""
    if workspace is None:
        n = problem.layout.size
        return problem.marginal(partial(problem.sums_of, state))[:n, :n]
    problem.linearise(state, workspace, problem.residuals(), curved=True)
    return solve(workspace, problem.n_keyframes, problem.tolerance).information


def _reading_noise(imu: ImuData, rng: np.random.Generator) -> np.ndarray:
    """(N, 6) random noise of rates and specific forces with the IMU's densities, not enlarged at gaps."""
    dt = np.median(np.diff(imu.seconds))
    density = np.repeat(np.sqrt(np.median(imu.variance[:, :2], axis=0)), 3)
    return density / np.sqrt(dt) * rng.standard_normal((len(imu.seconds), 6))


def _with_noise(problem: Problem, state: State, readings: np.ndarray) -> Problem:
    """The problem with `readings` (N, 6) added to the IMU readings of all factors, which are preintegrated at the
    biases of `state`."""
    old = problem.chain.imu
    assert old is not None
    imu = replace(old, gyro=old.gyro + readings[:, :3], accel=old.accel + readings[:, 3:])
    return problem.replacing([f.with_imu(imu, state) for f in problem.factors.values()])
