"""NEES and sampled covariances against scipy's formulas, on errors whose law is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg, stats
from scipy.spatial.distance import mahalanobis

from icalib.tools.montecarlo.summary import Sample, largest, nees, spread


def drawn(runs: int, n: int, optimism: float = 1.0, seed: int = 0) -> list[Sample]:
    """Samples with entries of very unlike size, each with a covariance of its own."""
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-6.0, 1.0, n)
    samples = []
    for k in range(runs):
        L = size[:, None] * (np.eye(n) + 0.2 * rng.standard_normal((n, n)))
        samples.append(Sample(k, L @ rng.standard_normal(n), L @ L.T / optimism**2))
    return samples


def test_nees_is_the_squared_mahalanobis_distance():
    samples = [*drawn(5, 3), *drawn(4, 2, seed=1)]
    squared = [mahalanobis(s.error, np.zeros(len(s.error)), linalg.inv(s.covariance)) ** 2 for s in samples]
    found = nees(samples)
    assert found.mean == pytest.approx(sum(squared) / (5 * 3 + 4 * 2), rel=1e-9)
    per_dof = [q / len(s.error) for q, s in zip(squared, samples, strict=True)]
    assert found.worst == pytest.approx(max(per_dof)) and found.worst_seed == samples[int(np.argmax(per_dof))].seed


def test_bounds_hold_what_chance_makes():
    found = nees(drawn(20, 3))
    assert stats.chi2.cdf(60 * found.low, 60) == pytest.approx(0.025)
    assert stats.chi2.sf(60 * found.high, 60) == pytest.approx(0.025)
    inside = [nees(drawn(20, 3, seed=s)).consistent for s in range(400)]
    assert 0.92 < np.mean(inside) < 0.98


@pytest.mark.parametrize("optimism", [0.8, 1.25])
def test_a_wrong_covariance_is_found(optimism: float):
    found = nees(drawn(100, 3, optimism))
    assert found.mean == pytest.approx(optimism**2, rel=0.2)
    assert not found.consistent


def test_a_direction_without_variance_is_an_enormity_and_no_traceback():
    singular = Sample(0, np.array([1e-3, -1e-3]), np.full((2, 2), 1e-6))
    assert nees([singular]).mean > 1e9


def test_spread_is_the_generalised_eigenvalues():
    samples = drawn(50, 4)
    sampled = sum(np.outer(s.error, s.error) for s in samples) / 50
    predicted = sum(s.covariance for s in samples) / 50
    D = 1.0 / np.sqrt(np.diag(predicted))  # scipy needs entries of about one size
    roots = np.sqrt(linalg.eigh(sampled * np.outer(D, D), predicted * np.outer(D, D), eigvals_only=True))
    found = spread(samples)
    assert found is not None
    assert (found.least, found.largest) == pytest.approx((roots[0], roots[-1]), rel=1e-6)


def test_spread_of_honest_and_dishonest_covariances():
    honest, twice = spread(drawn(100, 3)), spread(drawn(100, 3, optimism=2.0))
    assert honest is not None and twice is not None
    assert honest.least_bounds[0] < honest.least < honest.least_bounds[1]
    assert honest.largest_bounds[0] < honest.largest < honest.largest_bounds[1]
    assert (twice.least, twice.largest) == pytest.approx((2.0 * honest.least, 2.0 * honest.largest))
    assert twice.least > twice.least_bounds[1]


def test_bounds_of_one_dimension_are_those_of_chi2():
    found = spread(drawn(100, 1))
    assert found is not None and found.least == found.largest
    assert found.least_bounds == pytest.approx(np.sqrt(stats.chi2.ppf([0.025, 0.975], 100) / 100), rel=0.02)


def test_no_spread_of_too_few_runs_or_of_unlike_dimensions():
    assert spread(drawn(3, 3)) is None
    assert spread(drawn(4, 3)) is not None
    assert spread([*drawn(9, 3), *drawn(1, 2)]) is None


def test_the_largest_error_and_its_chance():
    found = largest([(1.0, "cam0.rotation x", 1), (-3.5, "cam0.rotation y", 2), (2.0, "cam1.time_offset", 2)])
    assert (found.sigmas, found.entry, found.seed, found.numbers) == (3.5, "cam0.rotation y", 2, 3)
    assert found.chance == pytest.approx(1.0 - (1.0 - 2.0 * stats.norm.sf(3.5)) ** 3)


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_chance_reaches_the_largest_as_often_as_is_said_or_less(correlation: float):
    rng = np.random.default_rng(3)
    shared = rng.standard_normal((2000, 1))
    z = np.sqrt(correlation) * shared + np.sqrt(1.0 - correlation) * rng.standard_normal((2000, 50))
    chances = np.array([largest([(value, "", 0) for value in row]).chance for row in z])
    below = float(np.mean(chances < 0.1))
    assert (abs(below - 0.1) < 0.02) if correlation == 0.0 else (below < 0.08)
