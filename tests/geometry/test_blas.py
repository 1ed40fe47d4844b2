"""BLAS on blocks of larger arrays, against the products they stand for; nothing beside the block may change."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.geometry.blas import factorise, solve_transposed, solve_upper, subtract_gram, subtract_product


def block(rng, rows, columns):
    """A block of a larger array, and that array."""
    whole = rng.standard_normal((rows + 5, columns + 9))
    return whole[2 : 2 + rows, 3 : 3 + columns], whole


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@each(("k", "m", "n"), [(7, 6, 20), (1, 1, 1), (1, 5, 1), (0, 4, 3), (40, 130, 90)])
def test_products_are_subtracted(rng, k, m, n):
    A, B = block(rng, k, m)[0], block(rng, k, n)[0]
    C, whole = block(rng, m, n)
    expected = whole.copy()
    expected[2 : 2 + m, 3 : 3 + n] -= A.T @ B
    subtract_product(A, B, C)
    np.testing.assert_allclose(whole, expected, rtol=0, atol=1e-12)


@each(("k", "n"), [(7, 20), (1, 1), (0, 3), (130, 90)])
def test_gram_is_subtracted_from_the_upper_triangle_alone(rng, k, n):
    W, (C, whole) = block(rng, k, n)[0], block(rng, n, n)
    expected = whole.copy()
    expected[2 : 2 + n, 3 : 3 + n] -= np.triu(W.T @ W)
    subtract_gram(W, C)
    np.testing.assert_allclose(whole, expected, rtol=0, atol=1e-12)


@each("n", [0, 1, 3, 70])
def test_factors_and_solutions(rng, n):
    J, (A, _), (X, _) = rng.standard_normal((2 * n + 1, n)), block(rng, n, n), block(rng, n, 4)
    H, right = J.T @ J, X.copy()
    A[:] = np.triu(H) + np.tril(np.full((n, n), np.nan), -1)
    assert factorise(A)
    U = np.triu(A)
    np.testing.assert_allclose(U.T @ U, H, rtol=0, atol=1e-10)
    solve_transposed(A, X)
    np.testing.assert_allclose(U.T @ X, right, rtol=0, atol=1e-10)
    x = right[:, 0].copy()
    solve_upper(A, x)
    np.testing.assert_allclose(U @ x, right[:, 0], rtol=0, atol=1e-10)


@each("bad", [-1.0, 0.0, np.nan, np.inf])
def test_what_is_not_positive_definite_is_refused(bad):
    assert not factorise(np.diag([1.0, bad, 1.0]))
