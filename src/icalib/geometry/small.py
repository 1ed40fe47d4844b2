"""Linear algebra of small dense matrices for compiled code: no BLAS, no memory."""

from __future__ import annotations

from math import sqrt

from numba import njit


@njit(cache=True, nogil=True)
def cholesky(A):
    """Lower Cholesky factor of A (n, n) in place of its lower triangle; False where A is not positive definite."""
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
def solve_definite(A, b):
    """b (n,) <- A^-1 b, overwriting A with its Cholesky factor; False where A is not positive definite."""
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
