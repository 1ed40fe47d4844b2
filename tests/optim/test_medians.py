"""Noise and its limits from quantiles, against plain formulas."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.optim.rows import grouped_quantiles, largest_normal, median_variance


def test_the_variance_is_that_of_the_noise_whatever_outliers_do():
    errors = 0.7 * np.random.default_rng(1).standard_normal((200_000, 2))
    assert median_variance((errors**2).sum(axis=1)) == pytest.approx(0.49, rel=0.01)
    errors[::50] = 1e6
    assert median_variance((errors**2).sum(axis=1)) == pytest.approx(0.49, rel=0.03)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_the_limit_is_mean_and_deviations_of_normal_errors(share: float):
    size = np.linalg.norm(3.0 * np.random.default_rng(2).standard_normal((400_000, 2)), axis=1)
    limit = largest_normal(4.0, share) * np.quantile(size, share)
    assert limit == pytest.approx(size.mean() + 4.0 * size.std(), rel=0.01)


@each("share", [0.0, 0.5, 0.9, 1.0])
def test_quantiles_by_group(share: float):
    rng = np.random.default_rng(3)
    x, group = rng.normal(size=500), rng.integers(0, 40, 500)
    group[group == 7] = 8
    found = grouped_quantiles(x, group, 41, share)
    for g in range(41):
        own = x[group == g]
        assert found[g] == (np.quantile(own, share, method="lower") if len(own) else np.inf)


def test_one_outlier_of_few_stands_out():
    """Its mean plus four standard deviations would be beyond it."""
    size = np.r_[np.full(9, 1.0), 40.0]
    assert size.mean() + 4.0 * size.std() > 40.0
    for share in (0.5, 0.9):
        assert largest_normal(4.0, share) * grouped_quantiles(size, np.zeros(10, dtype=int), 1, share)[0] < 40.0
