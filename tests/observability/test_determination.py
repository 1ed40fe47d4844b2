"""What is in doubt because noise may have made it, and what noise in the Jacobians does to the rest."""

import numpy as np
import pytest

from icalib.estimate.jacobian_noise import Spurious
from icalib.observability.determination import _are_alike, _joined, _principal_directions, error_covariance

DIRECTIONS = np.linalg.qr(np.random.default_rng(0).standard_normal((4, 4)))[0]
TOLERANCE = np.array([1e-3, 0.1, 2.0, 0.5])
NOTHING = np.zeros((2, 0))


def spurious(*scatter: float) -> Spurious:
    """Seven draws of noise, 6 on average along each of DIRECTIONS, in tolerance units, and with this scatter."""
    unit = np.linspace(-1.5, 1.5, 7)
    along = 6.0 + (unit / unit.std(ddof=1))[:, None] * np.array(scatter)
    return Spurious(np.einsum("ik,nk,jk->nij", DIRECTIONS, along, DIRECTIONS) / np.outer(TOLERANCE, TOLERANCE))


def test_only_what_may_be_noise_by_chance_is_in_doubt():
    """Beside noise of 6 there are 3 that it hardly reaches, 2 that it may, 7 that it may but that are most of it, and
    next to nothing."""
    asked = DIRECTIONS @ np.diag([9.0, 8.0, 13.0, 6.001]) @ DIRECTIONS.T
    seen = _principal_directions(asked, TOLERANCE, np.ones(4, dtype=bool), spurious(0.1, 2.0, 2.0, 0.1))
    along = (DIRECTIONS.T @ seen.vectors) ** 2
    np.testing.assert_allclose(along @ seen.maybe_noise, [0.0, 1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(along @ seen.unobservable, [0.0, 0.0, 0.0, 1.0], atol=1e-9)


def test_whether_all_else_is_determined_is_asked_with_nuisance_parameters_known():
    """Data show only the difference of one parameter and a nuisance: the parameter is determined. The third parameter,
    of which they show nothing, is unobservable."""
    asked = np.zeros((3, 3))
    asked[np.ix_([0, 2], [0, 2])] = 4.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    nothing = Spurious(np.zeros((1, 3, 3)))
    seen = _principal_directions(asked, TOLERANCE[:3], np.array([True, True, False]), nothing)
    np.testing.assert_allclose(seen.vectors[:, seen.unobservable].T ** 2, [[0.0, 1.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize("n", [3, 7])
def test_noise_adds_more_than_is_allowed_for_once_in_a_thousand(n: int):
    rng, more = np.random.default_rng(1), 0
    for _ in range(20_000):
        *draws, this = rng.standard_normal(n + 1)
        found = Spurious(np.reshape(draws, (n, 1, 1)))
        more += this > found.mean[0, 0] + found.chance(np.eye(1))[0]
    assert 8 <= more <= 34  # 20 are expected; one study in a thousand has fewer or more


def test_noise_never_makes_a_variance_smaller():
    """Draws may say by chance that it takes something off, even more than there is."""
    known, noise = np.diag([2.0, -0.3, 5.0]), np.diag([-0.5, -3.0, 1.0])
    said = np.diag(error_covariance(known, noise, np.zeros((3, 0))))
    np.testing.assert_allclose(said[[0, 2]], [1.0 / 2.0, 1.0 / 5.0 + 1.0 / 25.0])
    assert said[1] > 1e3


def test_what_is_odd_in_noise_hardly_moves_a_variance():
    """Of two numbers that are known well, but only together, a little that takes off as much as it adds."""
    known = np.array([[1e6, -1e6 + 1.0], [-1e6 + 1.0, 1e6]])
    root = np.linalg.cholesky(np.linalg.inv(known))
    odd = np.linalg.inv(root).T @ (0.01 * np.array([[0.0, 1.0], [1.0, 0.0]])) @ np.linalg.inv(root)
    said, without = np.diag(error_covariance(known, odd, NOTHING)), np.diag(np.linalg.inv(known))
    assert (said >= without).all() and (said < 1.0101 * without).all()


def information(*along: float) -> np.ndarray:
    return DIRECTIONS @ np.diag(along) @ DIRECTIONS.T


def test_informations_are_alike_where_they_are_in_what_they_know():
    """What neither knows may differ by any factor; one that is not definite is like none."""
    before = information(100.0, 1e4, 1e-3, 1e-6)
    assert _are_alike(before, information(105.0, 0.95e4, 1.2e-3, 1e-5))
    assert not _are_alike(before, information(115.0, 1e4, 1e-3, 1e-6))
    assert not _are_alike(before, information(100.0, 1e4, 1e-2, 1e-6))
    assert not _are_alike(information(100.0, 1e4, -1.0, 0.0), before)


def test_one_draw_was_enough_and_allows_for_nothing():
    np.testing.assert_array_equal(Spurious(np.ones((1, 2, 2))).chance(np.eye(2)), 0.0)


def test_the_covariance_is_that_of_a_regression_with_noisy_regressors():
    """y = X b + noise of 1, X seen with noise: b from what the normal equations have, less the noise of X in them."""
    rng, n, sigma = np.random.default_rng(2), 5000, np.array([0.5, 1.0])
    X = rng.standard_normal((n, 2)) @ np.array([[1.0, 0.4], [0.0, 0.6]])
    known, noise = X.T @ X, n * np.diag(sigma**2)
    found = []
    for _ in range(2500):
        seen = X + sigma * rng.standard_normal((n, 2))
        found.append(np.linalg.solve(seen.T @ seen - noise, seen.T @ rng.standard_normal(n)))
    said, formal = error_covariance(known, noise, NOTHING), np.linalg.inv(known + noise)
    np.testing.assert_allclose(np.cov(np.array(found).T), said, rtol=0.12)
    assert (np.diag(said) > 2.0 * np.diag(formal)).all()


def test_of_two_null_spaces_all_is_fixed_that_is_not_in_both():
    """A search that would cycle between them ended with a direction free of which the data know nothing."""
    axes, a = np.eye(5), np.deg2rad(20.0)
    other = np.column_stack([np.cos(a) * axes[0] + np.sin(a) * axes[3], axes[2]])
    both = _joined(axes[:, :2], other)
    np.testing.assert_allclose(both @ both.T, np.diag([1.0, 1.0, 1.0, 0.0, 0.0]), atol=1e-12)
    np.testing.assert_array_equal(_joined(axes[:, :2], other[:, :1]), axes[:, :2])
