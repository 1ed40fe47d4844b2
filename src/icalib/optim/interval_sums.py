"""What a measurement between neighbouring nodes adds to the normal equations."""

from __future__ import annotations

from icalib.base.compiled import njit


@njit(cache=True, nogil=True)
def add_interval(i, A0, A1, Ac, columns, sums):
    """Adds one interval to the sums of nodes i and i + 1 of the piece, and of the border.

    A0, A1 (m, 15): whitened Jacobians by the two nodes; Ac (m, n + 1): by border `columns` (n,), and the residual.
    """
    n_b = sums.side.shape[2] - 1
    _add_gram(A0, A0, sums.diagonal[i])
    _add_gram(A0, A1, sums.upper[i])
    _add_gram(A1, A1, sums.diagonal[i + 1])
    _scatter(A0, Ac, columns, n_b, sums.side[i])
    _scatter(A1, Ac, columns, n_b, sums.side[i + 1])
    if len(columns):
        _scatter_border(Ac, columns, n_b, sums.border)


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
def _scatter_border(Ac, cols, n_b, border):
    for k in range(Ac.shape[0]):
        for i in range(len(cols)):
            f = Ac[k, i]
            for j in range(len(cols)):
                border[cols[i], cols[j]] += f * Ac[k, j]
            border[cols[i], n_b] += f * Ac[k, len(cols)]
            border[n_b, cols[i]] += f * Ac[k, len(cols)]
