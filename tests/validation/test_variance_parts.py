"""The parts of formal variances, and the empirical factors on them."""

import numpy as np
import pytest

from icalib.optim.arrowhead import Prior, variance_of_priors
from icalib.optim.state import Block, State
from icalib.validation.assess import VarianceParts, with_correlations

NOTHING = np.zeros(0)


def test_a_parameter_that_only_its_prior_knows_takes_no_part_in_the_factor():
    """Its scatter over segments is rounding over rounding."""
    noise, prior = np.array([1.0, 0.8, 1e-9]), np.array([0.0, 0.2, 1.0])
    parts = VarianceParts(noise, prior, np.array([2.0, 2.0, 1e3]), 1.5)
    factors = parts.factor(np.arange(3), overall=1.0)
    assert factors[0] == pytest.approx(2.0, rel=1e-3)
    np.testing.assert_allclose(factors[2], 1.5, rtol=1e-6)
    assert parts.pooled(np.array([2])) == pytest.approx(1e3)
    assert parts.pooled(np.arange(0)) == 1.0


def test_errors_of_the_initial_guess_are_not_scaled_with_the_noise():
    parts = VarianceParts(np.array([0.25]), np.array([0.25]), np.array([2.0]), 3.0)
    np.testing.assert_allclose(parts.factor(np.arange(1), 1.0), np.sqrt(0.25 * 4.0 + 0.25 * 9.0 + 0.5))


def test_what_errors_of_a_prior_contribute_where_regressors_are_noisy():
    """y = X b + noise, X seen with noise, and a prior on b[1]: estimates scatter over means of the prior alone."""
    rng, n, sigma = np.random.default_rng(3), 400, 0.5
    X = rng.standard_normal((n, 2)) @ np.array([[1.0, 0.7], [0.0, 0.2]])
    seen = X + np.array([0.0, sigma]) * rng.standard_normal((n, 2))
    block = Block("imu0", "intrinsics", "nuisance", 2, 0)
    prior = Prior(block, np.zeros(2), np.array([1e3, 0.1]))
    known = seen.T @ seen - n * np.diag([0.0, sigma**2]) + np.diag(prior.sigma**-2.0)
    means = prior.sigma * rng.standard_normal((4000, 2))
    estimates = np.linalg.solve(known, (means / prior.sigma**2).T)
    empty = np.zeros((0, 3))
    state = State(NOTHING, np.zeros((0, 3, 3)), empty, empty, np.zeros((0, 6)), {block.key: np.zeros(2)})
    told = variance_of_priors(np.linalg.inv(known), [prior], state)
    np.testing.assert_allclose(told, estimates.var(axis=1), rtol=0.1)


def test_what_two_sensors_share_does_not_hide_the_noise_between_them():
    """Noise of 1 and 2, with a factor of 5, and an error of 10 that moves both alike: their difference has noise."""
    own, shared, factor = np.diag([1.0, 4.0]), np.full((2, 2), 100.0), np.array([5.0, 5.0])
    whole = np.sqrt((factor**2 * np.diag(own) + 100.0) / (np.diag(own) + 100.0))
    C = with_correlations(own, shared, factor, whole)
    np.testing.assert_allclose(np.diag(C), [101.0, 104.0])
    total = C * np.outer(whole, whole)
    np.testing.assert_allclose(total[0, 0] + total[1, 1] - 2.0 * total[0, 1], 25.0 * 5.0)
