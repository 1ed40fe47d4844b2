"""Residuals that are larger than their noise explains.

Degrees of freedom after the fit are sampled: where few are left of many rows, as where the noise of an IMU is taken to
be far too small and the motion follows it, what is left is no more than the error of that. Chi^2 over the most that it
could be is then still a bound.
"""

from __future__ import annotations

import numpy as np

from icalib.result.calibration import SensorFit

LARGE_CHI2 = 2.0  # per post-fit degree of freedom: above this it is worth a warning
# Times as large as their noise: then standard deviations mean nothing. Simulated with IMU noise ten times too small,
# residuals are 3 to 5 times as large, and errors up to 12 standard deviations.
FAR_BEYOND = 4.0
SAMPLED_DOF = 3.0  # times the square root of the number of residuals: how far off degrees of freedom may be


def dof_known(fit: SensorFit) -> bool:
    """Whether more degrees of freedom are left than they may be off by."""
    return fit.dof > SAMPLED_DOF * np.sqrt(fit.count)


def excess(fit: SensorFit) -> float:
    """How many times as large as their noise residuals are, or at least are; 1 where that is no news."""
    dof = fit.dof if dof_known(fit) else max(fit.dof, 0.0) + SAMPLED_DOF * np.sqrt(fit.count)
    ratio = fit.chi2 / max(dof, 1.0)
    return float(np.sqrt(ratio)) if ratio > LARGE_CHI2 else 1.0


def times(fit: SensorFit) -> str:
    """The same in words: "3.3x"."""
    return f"{'' if dof_known(fit) else 'at least '}{excess(fit):.2g}x"
