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


# Cross products of many vectors, and a comparison of vectors.
#
# Hermite cubics between two instants, and Lagrange polynomials through several.

MEDIAN_NORM = 1.538  # median length of a vector with three standard normal components


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(..., 3) cross products of a and b (..., 3), which are broadcast. For a few hundred vectors it is several times
    faster than numpy.cross."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        np.multiply(a[..., j], b[..., k], out=out[..., i])
        out[..., i] -= a[..., k] * b[..., j]
    return out


def is_near(a: np.ndarray, b: np.ndarray, share: float) -> bool:
    """Whether the norm of a - b is smaller than `share` times the norm of b."""
    return float(np.linalg.norm(a - b)) < share * float(np.linalg.norm(b))


def hermite(s: np.ndarray, end: np.ndarray, before: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Cubic in s from 0 at s = 0 to `end` at s = 1. before, behind: its derivatives by s at s = 0 and s = 1."""
    return s * (before + s * (3.0 * end - 2.0 * before - behind + s * (before + behind - 2.0 * end)))


def lagrange_weights(t: np.ndarray) -> np.ndarray:
    """(k, n) weights of k values at times t (k, n), with which the interpolating polynomial is evaluated at time 0."""
    weight = np.ones_like(t)
    for a in range(len(t)):
        for b in range(len(t)):
            if a != b:
                weight[a] *= t[b] / (t[b] - t[a])
    return weight


# Time integrals of signals that are linear between their stamps, and means of band-limited signals.

# Gauss-Legendre quadrature over -1/2 to 1/2, exact up to degree 5.
_GAUSS_NODES = np.array([-0.5, 0.0, 0.5]) * np.sqrt(0.6)
_GAUSS_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


def once_integrated(x: np.ndarray, dt: np.ndarray) -> np.ndarray:
    """(N, ...) integral of x (N, ...) from the first stamp to each, by the trapezoidal rule. dt (N - 1,): steps [s]."""
    out = np.zeros_like(x)
    out[1:] = np.cumsum(0.5 * (x[1:] + x[:-1]) * _along_first(dt, x), axis=0)
    return out


def twice_integrated(x: np.ndarray, once: np.ndarray, dt: np.ndarray) -> np.ndarray:
    """(N, ...) double integral of x (N, ...) from the first stamp to each, exact for a signal that is linear between
    stamps. once (N, ...): its first integral; dt (N - 1,): steps [s]."""
    step = _along_first(dt, x)
    out = np.zeros_like(x)
    out[1:] = np.cumsum(once[:-1] * step + (2.0 * x[:-1] + x[1:]) * step**2 / 6.0, axis=0)
    return out


def _along_first(dt: np.ndarray, x: np.ndarray) -> np.ndarray:
    """dt (n,), reshaped so that it multiplies x along its first axis."""
    return dt.reshape(-1, *(1,) * (x.ndim - 1))


@njit(cache=True, nogil=True)
def polynomial_means(t, x, spans, first, last, count, out):
    """Fills out (Q, m) with means of polynomials through samples x (N, m) at times t (N,).

    spans (Q, 2): begin and end of each mean, which may coincide. The polynomial passes through the `count` samples
    around the span, of those from number first to last (Q,); through fewer if there are no more.
    """
    for q in range(len(spans)):
        n = min(count, last[q] - first[q] + 1)
        middle = 0.5 * (spans[q, 0] + spans[q, 1])
        begin = np.searchsorted(t, middle, side="right") - n // 2
        begin = min(max(begin, first[q]), last[q] - n + 1)
        for c in range(x.shape[1]):
            out[q, c] = 0.0
        for g in range(3):
            at = middle + _GAUSS_NODES[g] * (spans[q, 1] - spans[q, 0])
            for i in range(n):
                weight = _GAUSS_WEIGHTS[g]
                for k in range(n):
                    if k != i:
                        weight *= (at - t[begin + k]) / (t[begin + i] - t[begin + k])
                for c in range(x.shape[1]):
                    out[q, c] += weight * x[begin + i, c]
