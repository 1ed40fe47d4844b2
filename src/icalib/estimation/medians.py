"""Noise from medians, so that outliers have no say."""

from __future__ import annotations

import numpy as np

MEDIAN_OF_SQUARE = 2.0 * np.log(2.0)  # median of chi^2 with two degrees of freedom


def median_variance(square: np.ndarray) -> float:
    """Of either component of normal errors in the image, from their squared lengths (n,), n > 0."""
    return float(np.median(square) / MEDIAN_OF_SQUARE)
