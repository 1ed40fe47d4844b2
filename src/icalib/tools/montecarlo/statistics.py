"""Consistency of errors and covariances over many runs: NEES, and sampled against predicted covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import erf, gammaincinv

PROBABILITY = 0.95  # that a consistent covariance has its statistic within the bounds
LEAST_VARIANCE = 1e-13  # smallest eigenvalue of a correlation matrix: below it is rounding
DRAWS = 400  # simulated studies, from which the bounds of the sampled covariance are found


@dataclass(frozen=True)
class Sample:
    """Error (m,) and covariance (m, m) of some entries of one run."""

    seed: int
    error: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Nees:
    """Normalised estimation error squared. mean: of e^T P^-1 e per degree of freedom, 1 for a consistent covariance;
    low, high: its bounds for a consistent covariance; worst_seed, worst: the run with the largest value."""

    mean: float
    low: float
    high: float
    worst_seed: int
    worst: float

    @property
    def consistent(self) -> bool:
        return self.low <= self.mean <= self.high


@dataclass(frozen=True)
class Spread:
    """Ratios of sampled to predicted standard deviation: square roots of the smallest and largest generalised
    eigenvalue of the two covariances, each with its bounds for a consistent covariance. They approach 1 if the
    covariance is consistent and the runs are many."""

    least: float
    least_bounds: tuple[float, float]
    largest: float
    largest_bounds: tuple[float, float]


@dataclass(frozen=True)
class Largest:
    """The largest of `numbers` errors. sigmas: error in standard deviations; entry, seed: its name and run.

    chance: upper bound of the probability of such an error for consistent covariances. Dependence between the errors
    makes the probability smaller.
    """

    sigmas: float
    entry: str
    seed: int
    numbers: int
    chance: float


def nees(samples: list[Sample], probability: float = PROBABILITY) -> Nees:
    """NEES of samples, which may differ in dimension: its sum is chi^2-distributed with the sum of the dimensions.
    probability: that the NEES of a consistent covariance is within the bounds."""
    each = np.array([_squared(s.error, s.covariance) for s in samples])
    dof = sum(len(s.error) for s in samples)
    low, high = gammaincinv(dof / 2, [0.5 - 0.5 * probability, 0.5 + 0.5 * probability]) / (dof / 2)
    per_dof = each / [len(s.error) for s in samples]
    worst = int(np.argmax(per_dof))
    return Nees(float(each.sum()) / dof, float(low), float(high), samples[worst].seed, float(per_dof[worst]))


def largest(errors: Sequence[tuple[float, str, int]]) -> Largest:
    """The largest of errors (error in standard deviations, entry, seed). For jointly normal errors, P(all |z| < c) is
    at least the product of the single probabilities (Sidak, JASA 62, 1967)."""
    z, entry, seed = max(errors, key=lambda error: abs(error[0]))
    return Largest(abs(z), entry, seed, len(errors), float(1.0 - erf(abs(z) / np.sqrt(2.0)) ** len(errors)))


def _squared(e: np.ndarray, P: np.ndarray) -> float:
    """e^T P^-1 e."""
    return float((np.linalg.solve(_factor(P), e) ** 2).sum())


def spread(samples: list[Sample]) -> Spread | None:
    """Spread of samples; None if they differ in dimension, or are too few for a sampled covariance of full rank."""
    n = len(samples[0].error)
    if len(samples) <= n or any(len(s.error) != n for s in samples):
        return None
    predicted = np.mean([s.covariance for s in samples], axis=0)
    roots = _roots(np.array([s.error for s in samples]), predicted)
    rng = np.random.default_rng(0)
    factors = np.array([_factor(s.covariance) for s in samples])
    drawn = [
        _roots(np.einsum("kij,kj->ki", factors, rng.standard_normal((len(samples), n))), predicted)
        for _ in range(DRAWS)
    ]
    low, high = np.quantile(drawn, [0.5 - 0.5 * PROBABILITY, 0.5 + 0.5 * PROBABILITY], axis=0)
    return Spread(float(roots[0]), (float(low[0]), float(high[0])), float(roots[-1]), (float(low[-1]), float(high[-1])))


def _roots(errors: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """(n,) square roots of the generalised eigenvalues of the mean of e e^T and `predicted` (n, n), ascending; errors
    (N, n)."""
    whitened = np.linalg.solve(_factor(predicted), errors.T)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(whitened @ whitened.T / len(errors)), 0.0))


def _factor(P: np.ndarray) -> np.ndarray:
    """L with L L^T = P. Entries are scaled first, since radians beside pixels make a badly conditioned matrix. A
    direction without variance gets LEAST_VARIANCE, so that an error in it counts as huge."""
    sigma = np.sqrt(np.diag(P))
    values, vectors = np.linalg.eigh(P / np.outer(sigma, sigma))
    return sigma[:, None] * vectors * np.sqrt(np.maximum(values, LEAST_VARIANCE))
