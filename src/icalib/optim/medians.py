"""Noise from medians and other quantiles, so that outliers have no say."""

from __future__ import annotations

import numpy as np

MEDIAN_CHI2_2DOF = 2.0 * np.log(2.0)  # median of chi^2 with two degrees of freedom


def median_variance(square: np.ndarray) -> float:
    """Of either component of normal errors in the image, from their squared lengths (n,), n > 0."""
    return float(np.median(square) / MEDIAN_CHI2_2DOF)


def largest_normal(deviations: float, share: float) -> float:
    """Mean plus so many standard deviations of the length of normal errors in the image (Rayleigh's distribution), in
    units of the length below which `share` of them lie."""
    mean, deviation = np.sqrt(np.pi / 2.0), np.sqrt(2.0 - np.pi / 2.0)
    return float((mean + deviations * deviation) / np.sqrt(-2.0 * np.log1p(-share)))


def grouped_quantiles(x: np.ndarray, group: np.ndarray, count: int, share: float) -> np.ndarray:
    """(count,) of x (n,) by group (n,): the largest below which `share` of the rest lies; infinite where there is
    nothing."""
    out = np.full(count, np.inf)
    ends = np.cumsum(np.bincount(group, minlength=count))
    for k, own in enumerate(np.split(x[np.argsort(group, kind="stable")], ends[:-1])):
        if len(own):
            at = int(share * (len(own) - 1))
            out[k] = np.partition(own, at)[at]
    return out
