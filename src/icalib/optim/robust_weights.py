"""Robust weights of the corners of one image, and their common error, which all corners share and which is
marginalised."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit

MIN_CURVATURE_RATIO = 1e-3  # floor of the curvature along a residual over its weight: keeps J^T J positive definite
LOSSES = {"none": 0, "huber": 1, "cauchy": 2}  # numbers of the setting's values in kernels


class Loss(NamedTuple):
    """Robust loss of whitened rows: kind (a number of LOSSES), scale in standard deviations, and whether the normal
    equations use its true curvature."""

    kind: int
    scale: float
    curved: bool


@njit(cache=True, nogil=True)
def weight(loss, scale, s):
    """Weight rho'(s), robust cost rho(s) / 2, and relative curvature 1 + 2 s rho'' / rho' along the residual (Triggs
    1999), at least MIN_CURVATURE_RATIO; s: squared norm of the whitened residual."""
    if loss == 0:
        return 1.0, 0.5 * s, 1.0
    if loss == 1:
        r = np.sqrt(s)
        if r <= scale:
            return 1.0, 0.5 * s, 1.0
        return scale / r, scale * r - 0.5 * scale * scale, MIN_CURVATURE_RATIO
    k = scale * scale
    return 1.0 / (1.0 + s / k), 0.5 * k * np.log1p(s / k), max((k - s) / (k + s), MIN_CURVATURE_RATIO)


@njit(cache=True, nogil=True)
def _invert_small(M, out):
    """Inverse of a small symmetric positive definite matrix by Gauss-Jordan."""
    n = M.shape[0]
    for i in range(n):
        for j in range(n):
            out[i, j] = 1.0 if i == j else 0.0
    for i in range(n):
        f = 1.0 / M[i, i]
        for j in range(n):
            M[i, j] *= f
            out[i, j] *= f
        for k in range(n):
            if k != i:
                f = M[k, i]
                for j in range(n):
                    M[k, j] -= f * M[i, j]
                    out[k, j] -= f * out[i, j]


@njit(cache=True, nogil=True, inline="always")
def robust_weights(res, keep, f, precision, sigma, loss, scale, root, shared):
    """Weights of the n corners of one image, and their common error. Fills root (n,): square roots of the weights over
    sigma (n,) px, 0 unless `keep`. Fills shared (m,): coefficients of the common error. Returns half the robust chi^2.

    res (n, 2) px; f (n, 2, m): change of each corner per unit of each coefficient; precision (m,): prior information of
    the coefficients. Weights and common error depend on each other, so a few rounds of reweighting minimise the cost
    over the common error.
    """
    n, m = len(keep), f.shape[2]
    for k in range(m):
        shared[k] = 0.0
    M, inv, rhs = np.empty((m, m)), np.empty((m, m)), np.empty(m)
    rounds = 1 if m == 0 else (2, 8, 24)[loss]
    cost = 0.0
    for turn in range(rounds):
        cost = 0.0
        for i in range(n):
            if not keep[i]:
                root[i] = 0.0
                continue
            u, v = res[i, 0], res[i, 1]
            for k in range(m):
                u += shared[k] * f[i, 0, k]
                v += shared[k] * f[i, 1, k]
            w, c, _ = weight(loss, scale, (u * u + v * v) / (sigma[i] * sigma[i]))
            root[i] = np.sqrt(w) / sigma[i]
            cost += c
        for k in range(m):
            cost += 0.5 * precision[k] * shared[k] ** 2
        if turn == rounds - 1:
            return cost
        _common_error(res, root, f, precision, M, inv, rhs, shared)
    return cost


@njit(cache=True, nogil=True, inline="always")
def _common_error(res, root, f, precision, M, inv, rhs, shared):
    """Coefficients (m,) of the common error at given weights: ridge regression of -res on the functions f."""
    m = f.shape[2]
    for a in range(m):
        rhs[a] = 0.0
        for b in range(m):
            M[a, b] = precision[a] if a == b else 0.0
    for i in range(len(root)):
        for axis in range(2):
            for a in range(m):
                wf = root[i] * root[i] * f[i, axis, a]
                for b in range(m):
                    M[a, b] += wf * f[i, axis, b]
                rhs[a] += wf * res[i, axis]
    _invert_small(M, inv)
    for a in range(m):
        shared[a] = 0.0
        for b in range(m):
            shared[a] -= inv[a, b] * rhs[b]


@njit(cache=True, nogil=True)
def add_common_error(res, f, shared, error):
    """Fills error (n, 2): residuals with the image's common error added."""
    for i in range(len(res)):
        for axis in range(2):
            error[i, axis] = res[i, axis]
            for k in range(f.shape[2]):
                error[i, axis] += shared[k] * f[i, axis, k]


@njit(cache=True, nogil=True)
def correct_curvature(A, D, i, n, r, factor):
    """Triggs' correction of corner i: scales its Jacobian rows along the residual r by `factor`, and the residual by
    its inverse. A (D + 1, 2 n): D Jacobian columns and the residual as rows; components u of all n corners, then v."""
    size = np.sqrt(r[0] * r[0] + r[1] * r[1])
    u, v = r[0] / size, r[1] / size
    for k in range(D + 1):
        along = u * A[k, i] + v * A[k, n + i]
        change = along * ((factor if k < D else 1.0 / factor) - 1.0)
        A[k, i] += change * u
        A[k, n + i] += change * v


@njit(cache=True, nogil=True)
def _elimination(A, D, n, F, precision, C, K):
    """Fills C (m, D): information of the common error of an image with the D parameters, and K (m, D): that times the
    covariance of the common error. Other arguments as in `marginalise_shared`."""
    m = len(precision)
    M, inv = np.empty((m, m)), np.empty((m, m))
    for a in range(m):
        for b in range(m):
            M[a, b] = precision[a] if a == b else 0.0
            for i in range(2 * n):
                M[a, b] += F[a, i] * F[b, i]
        for k in range(D):
            C[a, k], K[a, k] = 0.0, 0.0
            for i in range(2 * n):
                C[a, k] += F[a, i] * A[k, i]
    _invert_small(M, inv)
    for a in range(m):
        for b in range(m):
            for k in range(D):
                K[a, k] += inv[a, b] * C[b, k]


@njit(cache=True, nogil=True)
def marginalise_shared(A, D, n, F, precision, G):
    """Subtracts the Schur complement of the image's common error from the Gram matrix G (D + 1, D + 1). A (D + 1, 2 n):
    as in `correct_curvature`; F (m + 1, 2 n): the same with the columns of the common error.

    The gradient by the common error is zero, because the cost is minimal over it.
    """
    m = len(precision)
    C, K = np.empty((m, D)), np.empty((m, D))
    _elimination(A, D, n, F, precision, C, K)
    for a in range(m):
        for k in range(D):
            for c in range(D):
                G[k, c] -= K[a, k] * C[a, c]


@njit(cache=True, nogil=True)
def marginalise_gradients(A, D, n, F, precision, cluster, G):
    """Subtracts from gradients G (D, clusters) what each cluster of corners pulls the image's common error by. cluster
    (n,): index of each corner's cluster; other arguments as in `marginalise_shared`."""
    m = len(precision)
    C, K = np.empty((m, D)), np.empty((m, D))
    _elimination(A, D, n, F, precision, C, K)
    for a in range(m):
        for i in range(n):
            pull = F[a, i] * F[m, i] + F[a, n + i] * F[m, n + i]
            for k in range(D):
                G[k, cluster[i]] -= K[a, k] * pull
