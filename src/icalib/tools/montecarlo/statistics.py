"""Errors of many runs against what their covariances say: NEES, and the sampled covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import erf, gammaincinv

PROBABILITY = 0.95
LEAST_VARIANCE = 1e-13  # of a scaled covariance: rounding
DRAWS = 400  # of samples, for what chance alone makes of the sampled covariance


@dataclass(frozen=True)
class Sample:
    """One run's part: error (m,) and covariance (m, m)."""

    seed: int
    error: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Nees:
    """Mean of e^T P^-1 e per degree of freedom (1 where the covariance is honest), the bounds within which it lies by
    chance, and the run that has most of it."""

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
    """Square roots of the eigenvalues of sampled against predicted covariance: the least and the largest, each with
    the bounds within which it lies by chance. 1 where both are the same, and runs are without number."""

    least: float
    least_bounds: tuple[float, float]
    largest: float
    largest_bounds: tuple[float, float]


@dataclass(frozen=True)
class Largest:
    """The largest of `numbers` errors, in their own standard deviations: which, and in the run of which seed.

    chance: with which honest covariances leave one so large, at most; dependence of the numbers only lessens it.
    """

    sigmas: float
    entry: str
    seed: int
    numbers: int
    chance: float


def nees(samples: list[Sample], probability: float = PROBABILITY) -> Nees:
    """Of samples that may differ in dimension; the sum over them is chi^2 of the sum of these. `probability` that an
    honest covariance lies within the bounds."""
    each = np.array([_squared(s.error, s.covariance) for s in samples])
    dof = sum(len(s.error) for s in samples)
    low, high = gammaincinv(dof / 2, [0.5 - 0.5 * probability, 0.5 + 0.5 * probability]) / (dof / 2)
    per_dof = each / [len(s.error) for s in samples]
    worst = int(np.argmax(per_dof))
    return Nees(float(each.sum()) / dof, float(low), float(high), samples[worst].seed, float(per_dof[worst]))


def largest(errors: Sequence[tuple[float, str, int]]) -> Largest:
    """Of errors in standard deviations, each with its entry and seed. For normal errors, however they depend on each
    other, P(all |z| < c) is at least the product of each alone (Sidak, JASA 62, 1967)."""
    z, entry, seed = max(errors, key=lambda error: abs(error[0]))
    return Largest(abs(z), entry, seed, len(errors), float(1.0 - erf(abs(z) / np.sqrt(2.0)) ** len(errors)))


def _squared(e: np.ndarray, P: np.ndarray) -> float:
    """e^T P^-1 e."""
    return float((np.linalg.solve(_factor(P), e) ** 2).sum())


def spread(samples: list[Sample]) -> Spread | None:
    """Of samples of one dimension; None where they are too few for a sampled covariance of full rank."""
    n = len(samples[0].error)
    if len(samples) <= n or any(len(s.error) != n for s in samples):
        return None
    predicted = np.mean([s.covariance for s in samples], axis=0)
    found = _roots(np.array([s.error for s in samples]), predicted)
    rng = np.random.default_rng(0)
    factors = np.array([_factor(s.covariance) for s in samples])
    drawn = [
        _roots(np.einsum("kij,kj->ki", factors, rng.standard_normal((len(samples), n))), predicted)
        for _ in range(DRAWS)
    ]
    low, high = np.quantile(drawn, [0.5 - 0.5 * PROBABILITY, 0.5 + 0.5 * PROBABILITY], axis=0)
    return Spread(float(found[0]), (float(low[0]), float(high[0])), float(found[-1]), (float(low[-1]), float(high[-1])))


def _roots(errors: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """(n,) square roots of the generalised eigenvalues of the mean of e e^T, errors (N, n), against `predicted`."""
    whitened = np.linalg.solve(_factor(predicted), errors.T)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(whitened @ whitened.T / len(errors)), 0.0))


def _factor(P: np.ndarray) -> np.ndarray:
    """L with L L^T = P. Entries are scaled first, since radians beside pixels make a badly conditioned matrix; a
    direction without any variance is given a little, so that an error in it counts as the enormity that it is."""
    sigma = np.sqrt(np.diag(P))
    values, vectors = np.linalg.eigh(P / np.outer(sigma, sigma))
    return sigma[:, None] * vectors * np.sqrt(np.maximum(values, LEAST_VARIANCE))
