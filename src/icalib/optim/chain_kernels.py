"""Compiled block Cholesky elimination of a chain of keyframes with calibration parameters, and its back substitution
(`arrowhead.py`)."""

from __future__ import annotations

from icalib.base.compiled import njit
from icalib.geometry.small import cholesky


@njit(cache=True, nogil=True)
def forward_solve(L, X):
    """X <- L^-1 X."""
    for i in range(L.shape[0]):
        for k in range(i):
            f = L[i, k]
            for j in range(X.shape[1]):
                X[i, j] -= f * X[k, j]
        f = 1.0 / L[i, i]
        for j in range(X.shape[1]):
            X[i, j] *= f


@njit(cache=True, nogil=True)
def _subtract_product(A, B, X):
    """X <- X - A^T B."""
    for k in range(A.shape[0]):
        for i in range(A.shape[1]):
            f = A[k, i]
            if f != 0.0:
                for j in range(B.shape[1]):
                    X[i, j] -= f * B[k, j]


@njit(cache=True, nogil=True)
def _transpose(A):
    """A (n, n) <- A^T."""
    for i in range(A.shape[0]):
        for j in range(i):
            A[i, j], A[j, i] = A[j, i], A[i, j]


@njit(cache=True, nogil=True)
def eliminate_chain(diagonal, upper, side, forwards, keep):
    """Block Cholesky factorisation in place, from the first keyframe on or, not `forwards`, from the last. With `keep`
    the final keyframe is only updated. Returns False if a block is not positive definite.

    Afterwards diagonal holds L_k, upper L_k^-1 T[k, next] (transposed before, when running backwards), and side L_k^-1
    side.
    """
    n = diagonal.shape[0]
    for step in range(n):
        k = step if forwards else n - 1 - step
        if step == n - 1 and keep:
            return True
        if not cholesky(diagonal[k]):
            return False
        forward_solve(diagonal[k], side[k])
        if step < n - 1:
            after = k + 1 if forwards else k - 1
            link = upper[k] if forwards else upper[k - 1]
            if not forwards:
                _transpose(link)
            forward_solve(diagonal[k], link)
            _subtract_product(link, link, diagonal[after])
            _subtract_product(link, side[k], side[after])
    return True


@njit(cache=True, nogil=True)
def substitute_chain(diagonal, upper, side, forwards, keep, calib, white, chain):
    """Back substitution with the factors of `eliminate_chain`: fills chain (n, 15). With `keep` the final keyframe's
    step is an input.

    calib (B + 1,): step of the calibration parameters, and the factor of the gradient (1 solves, 0 samples). white (n,
    15): further right-hand side after forward substitution.
    """
    n = diagonal.shape[0]
    for step in range(n - 2 if keep else n - 1, -1, -1):
        k = step if forwards else n - 1 - step
        L = diagonal[k]
        for i in range(L.shape[0]):
            s = -white[k, i]
            for j in range(len(calib)):
                s += side[k, i, j] * calib[j]
            chain[k, i] = -s
        if step < n - 1:
            after = k + 1 if forwards else k - 1
            link = upper[k] if forwards else upper[k - 1]
            for i in range(L.shape[0]):
                for j in range(L.shape[0]):
                    chain[k, i] -= link[i, j] * chain[after, j]
        for i in range(L.shape[0] - 1, -1, -1):
            s = chain[k, i]
            for j in range(i + 1, L.shape[0]):
                s -= L[j, i] * chain[k, j]
            chain[k, i] = s / L[i, i]


@njit(cache=True, nogil=True)
def damp(diagonal, damping):
    """Multiplies the diagonal elements of all blocks by 1 + damping (Marquardt)."""
    for k in range(diagonal.shape[0]):
        for i in range(diagonal.shape[1]):
            diagonal[k, i, i] *= 1.0 + damping
