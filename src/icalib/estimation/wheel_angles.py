"""What wheels have turned: angles from rates."""

from __future__ import annotations

from typing import Literal

import numpy as np

RateReading = Literal["mean", "instant"]


def angles_from_rates(seconds: np.ndarray, rates: np.ndarray, reading: RateReading) -> np.ndarray:
    """(N, 2) rad that both wheels have turned since the first stamp, from their rates (N, 2) rad/s at seconds (N,).

    A rate is the "mean" over the period that ends at its stamp, as drivers that difference ticks publish it, or the
    value at the "instant" of its stamp (trapezoid). Taken for the other, it is late or early by half a period.
    """
    mean = rates[1:] if reading == "mean" else 0.5 * (rates[1:] + rates[:-1])
    angles = np.zeros_like(rates, dtype=np.float64)
    np.cumsum(mean * np.diff(seconds)[:, None], axis=0, out=angles[1:])
    return angles
