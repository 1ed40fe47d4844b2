"""What measurements between neighbouring nodes add to the normal equations: whitened, weighed, scattered."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.optim.robust_weights import weight


class Rows(NamedTuple):
    """n intervals of m rows: residual (n, m); J_node, J_next (n, m, 15), with respect to both nodes; J_calib (n, m,
    c): to calibration columns. Jacobians of length 0 where not wanted."""

    residual: np.ndarray
    J_node: np.ndarray
    J_next: np.ndarray
    J_calib: np.ndarray

    @classmethod
    def empty(cls, n: int, m: int, n_columns: int, jacobians: bool) -> Rows:
        k = n if jacobians else 0
        return cls(np.empty((n, m)), np.zeros((k, m, 15)), np.zeros((k, m, 15)), np.zeros((k, m, n_columns)))


@njit(cache=True, nogil=True)
def add_interval(i, A0, A1, Ac, columns, sums):
    """Adds one interval to the sums of nodes i and i + 1 of the piece, and of the calibration parameters.

    A0, A1 (m, 15): whitened Jacobians by the two nodes; Ac (m, n + 1): by calibration `columns` (n,), and the residual.
    """
    n_b = sums.side.shape[2] - 1
    _add_gram(A0, A0, sums.diagonal[i])
    _add_gram(A0, A1, sums.upper[i])
    _add_gram(A1, A1, sums.diagonal[i + 1])
    _scatter(A0, Ac, columns, n_b, sums.side[i])
    _scatter(A1, Ac, columns, n_b, sums.side[i + 1])
    if len(columns):
        _scatter_calib(Ac, columns, n_b, sums.calib)


@njit(cache=True, nogil=True)
def _add_gram(A, B, out):
    """out += A^T B."""
    for k in range(A.shape[0]):
        for i in range(A.shape[1]):
            f = A[k, i]
            if f != 0.0:
                for j in range(B.shape[1]):
                    out[i, j] += f * B[k, j]


@njit(cache=True, nogil=True)
def _scatter(A, Ac, cols, n_b, side):
    """side[:, cols] += A^T Ac, its last column (the gradient) into column n_b."""
    for k in range(A.shape[0]):
        for i in range(A.shape[1]):
            f = A[k, i]
            if f != 0.0:
                for j in range(len(cols)):
                    side[i, cols[j]] += f * Ac[k, j]
                side[i, n_b] += f * Ac[k, len(cols)]


@njit(cache=True, nogil=True, inline="always")
def _scatter_calib(Ac, cols, n_b, calib):
    for k in range(Ac.shape[0]):
        for i in range(len(cols)):
            f = Ac[k, i]
            for j in range(len(cols)):
                calib[cols[i], cols[j]] += f * Ac[k, j]
            calib[cols[i], n_b] += f * Ac[k, len(cols)]
            calib[n_b, cols[i]] += f * Ac[k, len(cols)]


@njit(cache=True, nogil=True)
def _weigh(r, loss, scaled, root):
    """root (m,): square roots of the weights of whitened residuals r (m,); scaled (2, m): what Jacobian and residual
    are multiplied by, so that J^T J, J^T r are those of the weights or, curved, of the loss. Returns half the robust
    chi^2."""
    cost = 0.0
    for q in range(len(r)):
        w, c, curvature = weight(loss.kind, loss.scale, r[q] * r[q])
        bend = np.sqrt(curvature) if loss.curved else 1.0
        root[q] = np.sqrt(w)
        scaled[0, q], scaled[1, q] = root[q] * bend, root[q] / bend
        cost += c
    return cost


@njit(cache=True, nogil=True)
def _whiten(W, J, columns, scale, out):
    """out (m, n) = diag(scale) W J[:, columns] for lower triangular W (m, m)."""
    for q in range(len(W)):
        for j in range(len(columns)):
            s = 0.0
            for k in range(q + 1):
                s += W[q, k] * J[k, columns[j]]
            out[q, j] = scale[q] * s


@njit(cache=True, nogil=True)
def accumulate_rows(rows, node, W, loss, free, columns, sums, residual, root):
    """Whitens rows by W (n, m, m), weighs them, and adds them to the sums where these are wanted.

    free, columns (c,): columns of J_calib that are estimated, and those in the calibration parameters. residual, root
    (n, m): whitened residuals and square roots of their weights, out. Returns half the robust chi^2."""
    m, n_c = W.shape[1], len(free)
    A0, A1, Ac = np.empty((m, 15)), np.empty((m, 15)), np.empty((m, n_c + 1))
    scaled, chain = np.empty((2, m)), np.arange(15)
    cost = 0.0
    for i in range(len(W)):
        for q in range(m):
            residual[i, q] = 0.0
            for k in range(q + 1):
                residual[i, q] += W[i, q, k] * rows.residual[i, k]
        cost += _weigh(residual[i], loss, scaled, root[i])
        if len(sums.diagonal) == 0:
            continue
        _whiten(W[i], rows.J_node[i], chain, scaled[0], A0)
        _whiten(W[i], rows.J_next[i], chain, scaled[0], A1)
        _whiten(W[i], rows.J_calib[i], free, scaled[0], Ac)
        for q in range(m):
            Ac[q, n_c] = scaled[1, q] * residual[i, q]
        add_interval(node[i] - sums.first, A0, A1, Ac, columns, sums)
    return cost
