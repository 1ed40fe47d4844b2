"""How much of the information on calibration parameters is only noise in the Jacobians.

A Jacobian that is taken at a noisy trajectory and noisy readings shows motion that was not there: where the truth is no
information at all, J^T J shows some, which grows with the square of the noise. What noise adds is measured by adding
it once more: S(x + d) - S(x), its mean over draws +-d of the trajectory's own posterior and of the IMU's noise.

The posterior takes the readings between a keyframe and an image, a sweep or a stamp for true; yet their noise turns the
trajectory, too. With a noisy IMU it may do so as much as all that the posterior knows of. So where a first draw shows
that noise counts, the trajectory follows noisier readings as the solver would have it, and what the posterior has of
their noise already is taken off: with u and v where all measurements, or the factors between keyframes alone, send it,
S(x + d + u) - S(x + v), for draws are independent and what they add is quadratic.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import stdtrit  # not scipy.stats, whose import takes 0.4 s

from icalib.estimate.problem.outcome import Outcome, posterior
from icalib.estimate.problem.problem import Problem
from icalib.motion.imu_data import ImuData
from icalib.optim.arrowhead import Piece, solve
from icalib.optim.calib_block import DETERMINED_ABOVE, UNOBSERVABLE_BELOW, least_information
from icalib.optim.state import State
from icalib.sensors.imu.residual import ImuFactor

# information in tolerance units: where all is known to a third of a tolerance, one pair will do
CLEARLY_DETERMINED = 10.0
# of the information: where all is determined and one side shows less, odd parts included, it will do
NEGLIGIBLE_SHARE = 0.01
SMALL_SHARE = 0.05  # of the information: where one pair finds less noise than this, it will do, too
N_FIRST_DRAWS = 3  # draws at first
CONFIDENCE = 0.999  # probability that noise adds no more than is allowed for


@dataclass(frozen=True)
class Spurious:
    """What noise adds to the calibration parameters' marginal information: of each draw, both signs together (n, B,
    B)."""

    each: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """(B, B)"""
        return self.each.mean(axis=0)

    def chance(self, directions: np.ndarray) -> np.ndarray:
        """(m,) by how much more than the mean noise may have added in this one recording, along directions (B, m);
        nothing where one draw was enough."""
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
    """What noise adds to the information on `columns` (B,) of the calibration parameters, by default all, the others
    fixed; zeros where there is no IMU. Where it counts, a few draws, more where these are not `enough`.

    Raises arrowhead.NotDefiniteError where the chain is not determined.
    """
    columns = np.arange(problem.layout.size) if columns is None else columns
    among = np.ix_(columns, columns)
    if not isinstance(problem.chain, ImuFactor):
        return Spurious(np.zeros((1, len(columns), len(columns))))
    rng = np.random.default_rng(0)
    t, information = problem.tolerance[columns], outcome.information[among]
    scaled = t[:, None] * information * t
    own = np.isin(columns, problem.layout.essential)
    least = least_information(information[np.ix_(own, own)], t[own])
    samples = (outcome.draws or posterior(problem, outcome.state)).still
    noise, first = _Noise(problem, outcome, among), _reading_noise(problem.chain.imu, rng)
    one_side = noise.there(1.0, samples[0].chain, first)
    if least > DETERMINED_ABOVE and _largest_share(t[:, None] * one_side * t, scaled) < NEGLIGIBLE_SHARE:
        return Spurious(one_side[None])
    found = 0.5 * (one_side + noise.there(-1.0, samples[0].chain, first))
    if least > CLEARLY_DETERMINED or _largest_share(t[:, None] * found * t, scaled) < SMALL_SHARE:
        return Spurious(found[None])
    each: list[np.ndarray] = []
    for some in (samples[1 : 1 + N_FIRST_DRAWS], samples[1 + N_FIRST_DRAWS :]):
        each += [noise.followed(d.chain, _reading_noise(problem.chain.imu, rng)) for d in some]
        if enough(Spurious(np.array(each))):
            break
    return Spurious(np.array(each))


@dataclass(frozen=True)
class _Noise:
    """What noise adds to the calibration parameters' information at an outcome, in the room of which it is found;
    `among` columns (B,) alone, as numpy.ix_ gives them."""

    problem: Problem
    outcome: Outcome
    among: tuple[np.ndarray, ...]

    def added(self, chain: np.ndarray, readings: np.ndarray | None) -> np.ndarray:
        """(B, B) on average, where the trajectory is off by +-chain (K, 15), and the readings by as often that."""
        return 0.5 * (self.there(1.0, chain, readings) + self.there(-1.0, chain, readings))

    def there(self, sign: float, chain: np.ndarray, readings: np.ndarray | None) -> np.ndarray:
        """(B, B), where the trajectory is off by `sign` times chain (K, 15), and the readings by as often that: noise,
        and what is odd in it."""
        there = self.outcome.state.retract(self.problem.layout, sign * chain, np.zeros(self.problem.layout.size))
        noisy = self.problem if readings is None else _with_noise(self.problem, there, sign * readings)
        return (_information(noisy, there, self.outcome.room) - self.outcome.information)[self.among]

    def followed(self, chain: np.ndarray, readings: np.ndarray) -> np.ndarray:
        """(B, B), where the trajectory follows noise of the `readings` beside a draw `chain` (K, 15) of its posterior,
        but that noise once."""
        everywhere = _with_noise(self.problem, self.outcome.state, readings)
        between_keyframes = self.problem.replacing([everywhere.chain])
        return self.added(chain + self._step(everywhere), readings) - self.added(self._step(between_keyframes), None)

    def _step(self, problem: Problem) -> np.ndarray:
        """(K, 15) where the solver would move the chain alone."""
        pieces = self.outcome.room or problem.pieces()
        problem.linearise(self.outcome.state, pieces, problem.residuals(), curved=True)
        factors = solve(pieces, problem.n_keyframes, problem.tolerance).factors
        calib = np.append(np.zeros(problem.layout.size), 1.0)[:, None]
        return factors.back(calib, [np.zeros((n, 1)) for n in factors.rows()])[:, :, 0]


def _largest_share(noise: np.ndarray, information: np.ndarray) -> float:
    """Of what is noise, in absolute value, in any direction that the solver moves along; both in tolerance units."""
    values, vectors = np.linalg.eigh(information)
    known = values > UNOBSERVABLE_BELOW
    half = vectors[:, known] / np.sqrt(values[known])
    return float(np.abs(np.linalg.eigvalsh(half.T @ noise @ half)).max(initial=0.0))


def _information(problem: Problem, state: State, room: tuple[Piece, ...] | None) -> np.ndarray:
    if room is None:
        n = problem.layout.size
        return problem.marginal(partial(problem.sums_of, state))[:n, :n]
    problem.linearise(state, room, problem.residuals(), curved=True)
    return solve(room, problem.n_keyframes, problem.tolerance).information


def _reading_noise(imu: ImuData, rng: np.random.Generator) -> np.ndarray:
    """(N, 6) noise of the readings, rate and force, as their densities say; none more beside gaps."""
    dt = np.median(np.diff(imu.seconds))
    density = np.repeat(np.sqrt(np.median(imu.variance[:, :2], axis=0)), 3)
    return density / np.sqrt(dt) * rng.standard_normal((len(imu.seconds), 6))


def _with_noise(problem: Problem, state: State, readings: np.ndarray) -> Problem:
    """The problem with noisier readings, everywhere, for the bias of `state`."""
    assert isinstance(problem.chain, ImuFactor)
    old = problem.chain.imu
    imu = replace(old, gyro=old.gyro + readings[:, :3], accel=old.accel + readings[:, 3:])
    factor = ImuFactor.build(imu, state, problem.chain.gravity, problem.chain.columns)
    others = [f.with_imu(imu) for f in problem.factors.values() if f is not problem.chain]
    return problem.replacing([factor, *others])
