"""Noise sizes from medians and other quantiles, which outliers hardly affect."""

from __future__ import annotations

import numpy as np

MEDIAN_CHI2_2DOF = 2.0 * np.log(2.0)  # median of chi^2 with 2 degrees of freedom


def median_variance(square: np.ndarray) -> float:
    """Variance of one component of isotropic normal errors in the plane, from the median of their squared lengths (n,),
    n > 0."""
    return float(np.median(square) / MEDIAN_CHI2_2DOF)


def largest_normal(deviations: float, share: float) -> float:
    """Largest plausible length of isotropic normal errors in the plane (Rayleigh distribution): `deviations` standard
    deviations above the mean length. The unit is the length that a `share` of the errors does not exceed."""
    mean, deviation = np.sqrt(np.pi / 2.0), np.sqrt(2.0 - np.pi / 2.0)
    return float((mean + deviations * deviation) / np.sqrt(-2.0 * np.log1p(-share)))


def grouped_quantiles(x: np.ndarray, group: np.ndarray, count: int, share: float) -> np.ndarray:
    """Quantiles (count,) at `share` of x (n,) within each `group` (n,) of 0..count - 1; inf for an empty group."""
    out = np.full(count, np.inf)
    ends = np.cumsum(np.bincount(group, minlength=count))
    for k, members in enumerate(np.split(x[np.argsort(group, kind="stable")], ends[:-1])):
        if len(members):
            at = int(share * (len(members) - 1))
            out[k] = np.partition(members, at)[at]
    return out
