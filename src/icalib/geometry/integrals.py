"""Time integrals of signals that are linear between their stamps."""

from __future__ import annotations

import numpy as np


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
