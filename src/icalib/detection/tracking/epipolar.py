"""Points that do not fit the motion of the camera between two images: least median of squares, compiled.

Rays f, h of a point that stands still satisfy h . E f = 0 in two images. E comes from eight points (Longuet-Higgins
1981) drawn at random; of many draws the one with the least median error counts, and what is far above that median does
not fit (Rousseeuw 1984; Zhang 1995). The median needs no threshold, so that a lens that is only roughly known, whose
errors are larger, rejects no more.
"""

from __future__ import annotations

import numpy as np
from numba import njit

DRAWS = 60  # with 30 % of outliers, chance misses every clean sample once in 35 pairs of images; with 20 %, never
REFITS, FITS_TIMES = 2, 4.0  # with all points whose errors are within so many medians
FEWEST = 16  # points; of fewer the median says little
TIMES_SIGMA = 3.0
LEAST_PX = 1.0  # no point is rejected for a smaller error


def fits_one_motion(f: np.ndarray, h: np.ndarray, px_per_rad: float, seed: int) -> np.ndarray:
    """(n,) bool: whether rays f and h (n, 3) of each point in two images fit one motion of the camera; all, where there
    are too few to tell."""
    if len(f) < FEWEST:
        return np.ones(len(f), dtype=bool)
    rng = np.random.default_rng(seed)
    draws = rng.permuted(np.tile(np.arange(len(f)), (DRAWS, 1)), axis=1)[:, :8].copy()
    error = np.empty(len(f))
    median = _least_median(f, h, draws, error)
    # Rousseeuw's correction for few points.
    sigma = 1.4826 * (1.0 + 5.0 / (len(f) - 8)) * median
    return error <= max(TIMES_SIGMA * sigma, LEAST_PX / px_per_rad)


@njit(cache=True, nogil=True)
def _least_median(f, h, draws, least):
    """The least median of errors [rad] over all draws (m, 8), and over what all points that fit then give; least (n,):
    the errors of that one."""
    best, error, fits = np.inf, np.empty(len(f)), np.empty(len(f), dtype=np.bool_)
    for k in range(len(draws) + REFITS):
        if k < len(draws):
            fits[:] = False
            for i in draws[k]:
                fits[i] = True
        else:
            for i in range(len(f)):
                fits[i] = least[i] <= FITS_TIMES * best
        _errors(f, h, _essential(f, h, fits), error)
        median = np.median(error)
        if median < best:
            best = median
            least[:] = error
    return best


@njit(cache=True, nogil=True)
def _essential(f, h, used):
    """E (3, 3), h . E f = 0 in least squares over the rays that are `used` (n,)."""
    A, row = np.zeros((9, 9)), np.empty(9)
    for k in range(len(f)):
        if not used[k]:
            continue
        for a in range(3):
            for b in range(3):
                row[3 * a + b] = h[k, a] * f[k, b]
        for a in range(9):
            for b in range(9):
                A[a, b] += row[a] * row[b]
    return np.ascontiguousarray(np.linalg.eigh(A)[1][:, 0]).reshape(3, 3)


@njit(cache=True, nogil=True)
def _errors(f, h, E, error):
    """error (n,) [rad]: first-order distance of each pair of rays from h . E f = 0 (Sampson's, on the sphere)."""
    for n in range(len(f)):
        value, size = 0.0, 0.0
        for a in range(3):
            by_h = E[a, 0] * f[n, 0] + E[a, 1] * f[n, 1] + E[a, 2] * f[n, 2]
            by_f = E[0, a] * h[n, 0] + E[1, a] * h[n, 1] + E[2, a] * h[n, 2]
            value += h[n, a] * by_h
            size += by_h * by_h + by_f * by_f
        # Rays move on the sphere only: the part of each derivative along its ray, which is `value`, does not count.
        error[n] = abs(value) / np.sqrt(max(size - 2.0 * value * value, 1e-18))
