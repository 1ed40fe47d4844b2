"""Residuals that are larger than the stated noise predicts.

The post-fit degrees of freedom are sampled. If few are left of many rows, their number is not known: this happens if
the stated noise of an IMU is far too small, so that the trajectory follows it. Chi^2 over the largest number that the
samples allow is then a lower bound.
"""

from __future__ import annotations

import numpy as np

from icalib.result.calibration import SensorFit

LARGE_CHI2 = 2.0  # per post-fit degree of freedom: a warning above it
# Ratio of residuals to the stated noise at which standard deviations mean nothing. If the stated noise of a simulated
# IMU is ten times too small, the ratio is 3 to 5, and errors reach 12 standard deviations.
FAR_BEYOND = 4.0
SAMPLED_DOF = 3.0  # largest error of sampled degrees of freedom, over the square root of the number of residuals


def dof_known(fit: SensorFit) -> bool:
    """Whether the degrees of freedom exceed their sampling error."""
    return fit.dof > SAMPLED_DOF * np.sqrt(fit.count)


def excess(fit: SensorFit) -> float:
    """Ratio of residuals to the stated noise, or a lower bound; 1 below `LARGE_CHI2`."""
    dof = fit.dof if dof_known(fit) else max(fit.dof, 0.0) + SAMPLED_DOF * np.sqrt(fit.count)
    ratio = fit.chi2 / max(dof, 1.0)
    return float(np.sqrt(ratio)) if ratio > LARGE_CHI2 else 1.0


def times(fit: SensorFit) -> str:
    """`excess` as text: "3.3x"."""
    return f"{'' if dof_known(fit) else 'at least '}{excess(fit):.2g}x"
