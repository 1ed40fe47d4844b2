"""Cubics between two instants."""

from __future__ import annotations

import numpy as np


def hermite(s: np.ndarray, end: np.ndarray, before: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """The cubic from 0 at s = 0 to `end` at s = 1, with derivatives by s `before` and `behind` there."""
    return s * (before + s * (3.0 * end - 2.0 * before - behind + s * (before + behind - 2.0 * end)))
