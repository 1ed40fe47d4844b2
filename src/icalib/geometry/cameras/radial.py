"""Radial distortion as an odd polynomial, f(r) = r (1 + k1 r^2 + k2 r^4 + ...): its monotonic range and its inverse."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from icalib.base.compiled import njit

_MAX_ITERATIONS = 100  # bisection alone reaches rounding in 60


def monotonic_limit(coefficients: np.ndarray) -> float:
    """The smallest r > 0 at which f'(r) = 1 + 3 k1 r^2 + 5 k2 r^4 + ... is zero; inf if there is none.

    Beyond this limit, points far outside the field of view would be projected into the image. Returns 0 if a
    coefficient is not finite.
    """
    return _monotonic_limit(tuple(coefficients.tolist()))


@lru_cache(maxsize=64)  # called once for each chunk of points, with the same coefficients
def _monotonic_limit(coefficients: tuple[float, ...]) -> float:
    if not np.isfinite(coefficients).all():
        return 0.0
    # The polynomial is monic in w = 1 / r^2, so that vanishing leading coefficients need no special case.
    odd = 2.0 * np.arange(len(coefficients)) + 3.0
    roots = np.roots(np.concatenate([[1.0], odd * coefficients]))
    inverse_squares = roots.real[(roots.imag == 0.0) & (roots.real > 0.0)]
    return float(inverse_squares.max() ** -0.5) if len(inverse_squares) else np.inf


@njit(cache=True, nogil=True)
def evaluate(coefficients, r):
    """f(r) and f'(r)."""
    s = r * r
    value = 0.0
    slope = 0.0
    for i in range(len(coefficients) - 1, -1, -1):
        value = (value + coefficients[i]) * s
        slope = (slope + (2 * i + 3) * coefficients[i]) * s
    return r * (1.0 + value), 1.0 + slope


@njit(cache=True, nogil=True)
def invert(coefficients, distorted, limit):
    """r in [0, limit) with f(r) = distorted >= 0, to rounding, by Newton's method in a bracket; `limit` if there is no
    solution."""
    low = 0.0
    high = limit
    if limit == np.inf:
        high = 1.0 + distorted
        while evaluate(coefficients, high)[0] < distorted:
            high *= 2.0
    elif not distorted < evaluate(coefficients, limit)[0]:
        return limit
    r = min(distorted, 0.5 * (low + high))
    for _ in range(_MAX_ITERATIONS):
        value, slope = evaluate(coefficients, r)
        if value < distorted:
            low = r
        else:
            high = r
        step = (distorted - value) / slope if slope > 0.0 else np.inf
        following = r + step
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if abs(following - r) <= 2e-16 * r:
            return following
        r = following
    return r
