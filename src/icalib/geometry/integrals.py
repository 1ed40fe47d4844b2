"""Time integrals of signals that are linear between their stamps, and means of band-limited signals."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit

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
