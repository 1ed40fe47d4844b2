"""Residuals that are larger or smaller than the stated noise predicts.

The post-fit degrees of freedom are estimated by sampling. If they are few compared with the number of residuals, the
estimate is unreliable. This happens if the stated noise of an IMU is far too small, so that the trajectory fits that
noise. The ratio is then computed with the largest number of degrees of freedom within the sampling error, as a lower
bound.
"""

from __future__ import annotations

import numpy as np

from icalib.result.calibration import SensorFit

LARGE_CHI2 = 2.0  # chi^2 per post-fit degree of freedom above which a warning is given
# Ratio of residuals to the stated noise above which standard deviations are meaningless. If the stated noise of a
# simulated IMU is ten times too small, the ratio is 3 to 5, and errors reach 12 standard deviations.
FAR_BEYOND = 4.0
SMALL_CHI2 = 0.5  # chi^2 per post-fit degree of freedom below which a warning is given
SAMPLED_DOF = 3.0  # largest error of sampled degrees of freedom, over the square root of the number of residuals


def dof_known(fit: SensorFit) -> bool:
    """Whether the degrees of freedom exceed their sampling error of `SAMPLED_DOF` * sqrt(count)."""
    return fit.dof > SAMPLED_DOF * np.sqrt(fit.count)


def largest_dof(fit: SensorFit) -> float:
    """Upper bound of the degrees of freedom, by their sampling error; at least 1."""
    return max(min(max(fit.dof, 0.0) + SAMPLED_DOF * np.sqrt(fit.count), fit.count), 1.0)


def excess(fit: SensorFit) -> float:
    """Ratio of residuals to the stated noise, sqrt(chi^2 / dof); a lower bound if not `dof_known`. 1 if chi^2 / dof is
    below `LARGE_CHI2`."""
    chi2_per_dof = fit.chi2 / (fit.dof if dof_known(fit) else largest_dof(fit))
    return float(np.sqrt(chi2_per_dof)) if chi2_per_dof > LARGE_CHI2 else 1.0


def is_small(fit: SensorFit) -> bool:
    """Whether the residuals are much smaller than the stated noise predicts."""
    return dof_known(fit) and fit.chi2 / max(fit.dof, 1.0) < SMALL_CHI2


def ratio(fit: SensorFit) -> float:
    """Ratio of residuals to the stated noise, sqrt(chi^2 / dof), for known degrees of freedom."""
    return float(np.sqrt(max(fit.chi2, 0.0) / fit.dof))


def times(fit: SensorFit) -> str:
    """`excess` as text, such as "3.3x" or "at least 3.3x"."""
    return f"{'' if dof_known(fit) else 'at least '}{excess(fit):.2g}x"
