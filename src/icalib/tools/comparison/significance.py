"""Significance of a difference, in standard deviations of a normal variable."""

from __future__ import annotations

from math import erfc, exp, gamma, sqrt
from statistics import NormalDist

import numpy as np

_SINGULAR = 1e-10  # smaller eigenvalues of the correlation matrix are zero
_SMALLEST_P = 1e-14  # the normal quantile of a smaller probability has lost its digits


def sigmas(difference: np.ndarray, covariance: np.ndarray) -> float | None:
    """Significance of a difference (n,) with covariance (n, n): the two-sided normal deviate that has the p-value of
    its Mahalanobis distance.

    None if the covariance is unknown (NaN), or if an entry with variance 0 differs. Entries with variance 0 that do not
    differ are left out.
    """
    if not np.isfinite(covariance).all():
        return None
    loose = np.diag(covariance) > 0
    if not loose.any() or np.any(difference[~loose] != 0):
        return None
    scale = np.sqrt(np.diag(covariance)[loose])
    correlation = covariance[np.ix_(loose, loose)] / np.outer(scale, scale)
    whitened = difference[loose] / scale
    chi2 = float(whitened @ np.linalg.pinv(correlation, _SINGULAR, hermitian=True) @ whitened)
    dof = int(np.linalg.matrix_rank(correlation, _SINGULAR * len(scale), hermitian=True))
    p = chi2_above(chi2, dof)
    return sqrt(chi2) if p < _SMALLEST_P else max(0.0, NormalDist().inv_cdf(1.0 - 0.5 * p))


def chi2_above(x: float, dof: int) -> float:
    """Probability that chi^2 with `dof` degrees of freedom is above x (Abramowitz and Stegun 26.4.4, 26.4.5)."""
    half = 0.5 * x
    p = erfc(sqrt(half)) if dof % 2 else exp(-half)
    return p + sum(exp(-half) * half ** (0.5 * k - 1.0) / gamma(0.5 * k) for k in range(4 - dof % 2, dof + 1, 2))
