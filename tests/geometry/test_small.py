"""Linear algebra of small matrices, against numpy's."""

from __future__ import annotations

import numpy as np
from tests.cases import each

from icalib.geometry.small import cross3, eigen3, mulv3, tmulv3

VALUES = [(1.0, 2.0, 3.0), (1e-8, 1.0, 1.0), (2.0, 2.0, 2.0), (-1.0, 1e-12, 100.0), (0.0, 0.0, 0.0)]


@each("values", VALUES)
def test_eigenvalues_and_vectors_are_those_of_numpy(values):
    rng = np.random.default_rng(3)
    for _ in range(20):
        Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        A = Q @ np.diag(values) @ Q.T
        A = 0.5 * (A + A.T)
        found, vectors, size = np.empty(3), np.empty((3, 3)), max(np.abs(values).max(), 1e-300)
        eigen3(A.copy(), found, vectors)
        np.testing.assert_allclose(found, np.linalg.eigvalsh(A), atol=1e-14 * size)
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(vectors @ np.diag(found) @ vectors.T, A, atol=1e-14 * size)


def test_products_with_vectors_are_those_of_numpy():
    A, x, y = (np.random.default_rng(4).normal(size=shape) for shape in ((3, 3), 3, 3))
    np.testing.assert_allclose(mulv3(A, x), A @ x, atol=1e-14)
    np.testing.assert_allclose(tmulv3(A, x), A.T @ x, atol=1e-14)
    np.testing.assert_allclose(cross3(x, y), np.cross(x, y), atol=1e-14)
