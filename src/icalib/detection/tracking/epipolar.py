"""Compiled: the epipolar geometry of two images through an unknown lens.

A pixel at (x, y) from the image centre has the ray (x, y, 1 + lam (x^2 + y^2)). This is the division model of
Fitzgibbon (Simultaneous linear estimation of multiple view geometry and lens distortion, 2001). Rays f, h of a static
point satisfy h . F f = 0. F absorbs the focal length, so only the distortion `lam` of the lens must be known.

F is estimated from eight random points, in many draws. The one with the least quantile of errors is used (least
quantile of squares, Rousseeuw 1984). The quantile is above the median: F is flexible enough to fit a moving body that
covers nearly half of the image.
"""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit

MOST_DRAWS = 60  # draws, at most; with 30 % of outliers, none is free of outliers for one in 35 pairs of images
FEWEST_DRAWS, MISSED = 12, 0.01  # draws, at least; probability that no draw is free of outliers at which drawing ends
# up to 35 % of the points may move; the same quantile of the absolute value of a standard normal variable
QUANTILE, QUANTILE_OF_NORMAL = 0.65, 0.9346
REFITS, FITS_TIMES = 2, 3.0  # refits to all points whose errors are within this multiple of the quantile
FEWEST_MATCHED_POINTS = 16  # fewer points give an unreliable quantile


def epipolar_errors(p: np.ndarray, q: np.ndarray, lam: float, seed: int) -> tuple[np.ndarray, float]:
    """First-order distances (n,) of points p and q (n, 2) in two images from the epipolar geometry of most of them, and
    their standard deviation by the quantile. Units are those of p and q, relative to the image centres; n must be at
    least FEWEST_MATCHED_POINTS."""
    rng = np.random.default_rng(seed)
    draws = rng.permuted(np.tile(np.arange(len(p)), (MOST_DRAWS, 1)), axis=1)[:, :8].copy()
    error = np.empty(len(p))
    quantile = _least_quantile(np.ascontiguousarray(p), np.ascontiguousarray(q), lam, draws, error)
    return error, (1.0 + 5.0 / (len(p) - 8)) / QUANTILE_OF_NORMAL * quantile  # Rousseeuw's correction for few points


@njit(cache=True, nogil=True)
def _least_quantile(p, q, lam, draws, least):
    """The least quantile of errors over all draws (m, 8) and refits to all points that fit; fills least (n,) with the
    errors of this F."""
    n = len(p)
    f, h, error, used = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, dtype=np.bool_)
    for i in range(n):
        f[i, 0], f[i, 1], f[i, 2] = p[i, 0], p[i, 1], 1.0 + lam * (p[i, 0] ** 2 + p[i, 1] ** 2)
        h[i, 0], h[i, 1], h[i, 2] = q[i, 0], q[i, 1], 1.0 + lam * (q[i, 0] ** 2 + q[i, 1] ** 2)
    best, k, last = np.inf, 0, len(draws)
    while k < last + REFITS:
        if k < last:
            used[:] = False
            for i in draws[k]:
                used[i] = True
        else:
            for i in range(n):
                used[i] = least[i] <= FITS_TIMES * best
        k += 1
        _errors(f, h, lam, _fundamental(f, h, used), error)
        quantile = np.partition(error, int(QUANTILE * n))[int(QUANTILE * n)]
        if quantile < best:
            best = quantile
            least[:] = error
            if k < last:
                last = max(min(last, _draws_needed(least, best)), k)
    return best


@njit(cache=True, nogil=True)
def _draws_needed(error, quantile):
    """Number of draws of eight points after which none is free of outliers with probability MISSED."""
    fits = 0
    for e in error:
        fits += e <= FITS_TIMES * quantile
    clean = (fits / len(error)) ** 8
    return FEWEST_DRAWS if clean > 0.99 else max(FEWEST_DRAWS, int(np.log(MISSED) / np.log(1.0 - clean)) + 1)


@njit(cache=True, nogil=True)
def _fundamental(f, h, used):
    """F (3, 3) with h . F f = 0, by linear least squares over the rays with `used` (n,)."""
    A, row = np.zeros((9, 9)), np.empty(9)
    for i in range(len(f)):
        if not used[i]:
            continue
        for a in range(3):
            for b in range(3):
                row[3 * a + b] = h[i, a] * f[i, b]
        for a in range(9):
            for b in range(9):
                A[a, b] += row[a] * row[b]
    return np.ascontiguousarray(np.linalg.eigh(A)[1][:, 0]).reshape(3, 3)


@njit(cache=True, nogil=True)
def _errors(f, h, lam, F, error):
    """Fills error (n,) with Sampson's distance: |h . F f| over the norm of its derivatives by the four pixel
    coordinates."""
    for i in range(len(f)):
        value, size = 0.0, 0.0
        l0, l1, l2 = 0.0, 0.0, 0.0  # F f
        m0, m1, m2 = 0.0, 0.0, 0.0  # F^T h
        for b in range(3):
            l0, l1, l2 = l0 + F[0, b] * f[i, b], l1 + F[1, b] * f[i, b], l2 + F[2, b] * f[i, b]
            m0, m1, m2 = m0 + F[b, 0] * h[i, b], m1 + F[b, 1] * h[i, b], m2 + F[b, 2] * h[i, b]
        value = h[i, 0] * l0 + h[i, 1] * l1 + h[i, 2] * l2
        size += (l0 + 2.0 * lam * h[i, 0] * l2) ** 2 + (l1 + 2.0 * lam * h[i, 1] * l2) ** 2
        size += (m0 + 2.0 * lam * f[i, 0] * m2) ** 2 + (m1 + 2.0 * lam * f[i, 1] * m2) ** 2
        error[i] = abs(value) / np.sqrt(max(size, 1e-30))
