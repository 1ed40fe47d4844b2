"""Hermite cubics between two instants, and Lagrange polynomials through several."""

from __future__ import annotations

import numpy as np


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
