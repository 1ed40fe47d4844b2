"""Linear algebra of small dense matrices for compiled code, without BLAS."""

from __future__ import annotations

from math import sqrt

import numpy as np

from icalib.base.compiled import njit

SWEEPS = 12  # largest number of Jacobi sweeps; five are typical
# All functions use loops, as array expressions take ten times as long to compile and are no faster at this size.


@njit(cache=True, nogil=True)
def mul3(a, b):
    """(3, 3) product a b."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return out


@njit(cache=True, nogil=True)
def tmul3(a, b):
    """(3, 3) product a^T b."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]
    return out


@njit(cache=True, nogil=True)
def mulv3(a, x):
    """(3,) product a x of a matrix (3, 3) and a vector (3,)."""
    out = np.empty(3)
    for i in range(3):
        out[i] = a[i, 0] * x[0] + a[i, 1] * x[1] + a[i, 2] * x[2]
    return out


@njit(cache=True, nogil=True)
def tmulv3(a, x):
    """(3,) product a^T x of a matrix (3, 3) and a vector (3,)."""
    out = np.empty(3)
    for i in range(3):
        out[i] = a[0, i] * x[0] + a[1, i] * x[1] + a[2, i] * x[2]
    return out


@njit(cache=True, nogil=True)
def cross3(a, b):
    """(3,) cross product a x b."""
    out = np.empty(3)
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return out


@njit(cache=True, nogil=True)
def cholesky(A):
    """Overwrite the lower triangle of A (n, n) with its Cholesky factor. False if A is not positive definite."""
    n = A.shape[0]
    for j in range(n):
        d = A[j, j]
        for k in range(j):
            d -= A[j, k] * A[j, k]
        if not d > 0.0:
            return False
        d = sqrt(d)
        A[j, j] = d
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            A[i, j] = s / d
    return True


@njit(cache=True, nogil=True)
def inverse_cholesky(P, W):
    """Fill W with L^-1, for P = L L^T (n, n), so that W r is white if P is the covariance of r. The lower triangle of P
    is overwritten with L."""
    n = P.shape[0]
    for j in range(n):
        for i in range(j, n):
            s = P[i, j]
            for k in range(j):
                s -= P[i, k] * P[j, k]
            P[i, j] = np.sqrt(s) if i == j else s / P[j, j]
    W[:] = 0.0
    for j in range(n):
        W[j, j] = 1.0 / P[j, j]
        for i in range(j + 1, n):
            s = 0.0
            for k in range(j, i):
                s -= P[i, k] * W[k, j]
            W[i, j] = s / P[i, i]


@njit(cache=True, nogil=True)
def solve_definite(A, b):
    """b (n,) <- A^-1 b; A is overwritten with its Cholesky factor. False if A is not positive definite."""
    if not cholesky(A):
        return False
    n = len(b)
    for i in range(n):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]
    return True


@njit(cache=True, nogil=True)
def eigen3(A, values, vectors):
    """Fill eigenvalues (3,), in increasing order, and eigenvectors, the columns of (3, 3), of a symmetric A (3, 3),
    which is overwritten. Jacobi's method (Golub and Van Loan, Matrix Computations, 8.5)."""
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        size = A[0, 0] * A[0, 0] + A[1, 1] * A[1, 1] + A[2, 2] * A[2, 2]
        if A[0, 1] * A[0, 1] + A[0, 2] * A[0, 2] + A[1, 2] * A[1, 2] <= 1e-32 * size:
            break
        for p, q in ((0, 1), (0, 2), (1, 2)):
            if A[p, q] == 0.0:
                continue
            tau = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
            t = 1.0 / (abs(tau) + sqrt(1.0 + tau * tau))
            t = t if tau >= 0.0 else -t
            c = 1.0 / sqrt(1.0 + t * t)
            s = t * c
            for k in range(3):
                A[k, p], A[k, q] = c * A[k, p] - s * A[k, q], s * A[k, p] + c * A[k, q]
            for k in range(3):
                A[p, k], A[q, k] = c * A[p, k] - s * A[q, k], s * A[p, k] + c * A[q, k]
                vectors[k, p], vectors[k, q] = (
                    c * vectors[k, p] - s * vectors[k, q],
                    s * vectors[k, p] + c * vectors[k, q],
                )
    for i in range(3):
        values[i] = A[i, i]
    for i, j in ((0, 1), (1, 2), (0, 1)):
        if values[j] < values[i]:
            values[i], values[j] = values[j], values[i]
            for k in range(3):
                vectors[k, i], vectors[k, j] = vectors[k, j], vectors[k, i]
