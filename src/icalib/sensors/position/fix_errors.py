"""Outliers, bursts of wrong fixes, and a slow random walk, found in the residuals of fixes.

Some fixes do not fit the trajectory. They are single, or they come in bursts: consecutive fixes with a common offset,
as between buildings.

The first pass bounds their influence by Huber's loss, which is convex. Each later pass begins by rejecting fixes with
large residuals, and is a least-squares fit to the rest. The median of the residuals gives their scale (reweighted
least squares; Rousseeuw and Leroy, Robust Regression and Outlier Detection, 1987, section 1.2). A rejected fix is
tested again before each pass.

A long burst pulls the trajectory towards it, so that its residuals are small. The IMU does not let the trajectory jump
between neighbouring fixes. Residuals therefore step by the whole offset at the begin and at the end of the burst.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr
from scipy.stats import chi2

from icalib.sensors.position.read.outliers import MAX_GAP_STEPS, MIN_OUTLIER_M, MIN_STEP_M

MIN_STEP_SIGMAS = 6.0  # of a step of the residuals: noise exceeds it in 1 of 10^8 steps
STRUCTURE_LAG_S = 1.0  # longest lag: over longer ones the trajectory absorbs most of the slow errors


def outliers_of(whitened: np.ndarray, raw: np.ndarray, deviations: float) -> np.ndarray:
    """(n,) bool: True for outliers, by the residuals of the fixes, whitened (n, 3) and raw (n, 3) m.

    Horizontal and vertical residuals are scaled by the median of each group, so that the size of the noise need not be
    known. deviations: limit in standard deviations of a normal variable. The limit on chi^2 has the same probability.
    """
    rare, outliers = 2.0 * ndtr(-deviations), np.zeros(len(whitened), dtype=bool)
    for columns, freedom in ((slice(0, 2), 2), (slice(2, 3), 1)):
        squares = (whitened[:, columns] ** 2).sum(axis=1)
        typical = np.median(squares) / chi2.ppf(0.5, freedom) if len(squares) else 1.0
        far = np.linalg.norm(raw[:, columns], axis=1) > MIN_OUTLIER_M
        outliers |= far & (squares > typical * chi2.isf(rare, freedom))
    return outliers


def bursts_of(seconds: np.ndarray, raw: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(n,) bool: True for fixes at `seconds` (n,) in bursts, which begin and end with a step of the residuals. raw,
    sigma (n, 3) m: residuals, and their standard deviations up to a common factor.

    The sum of the steps gives the offset of each fix from the first one. Between two gaps, fixes with an offset more
    than MIN_STEP_M from the median offset are in a burst.
    """
    wrong, dt = np.zeros(len(seconds), dtype=bool), np.diff(seconds)
    if not len(dt):
        return wrong
    moved = np.diff(raw, axis=0)
    size, expected = (moved**2).sum(axis=1), (sigma[1:] ** 2 + sigma[:-1] ** 2).sum(axis=1)
    typical = np.median(size / expected) * 3.0 / chi2.ppf(0.5, 3)
    gap = dt > MAX_GAP_STEPS * np.median(dt)
    is_step = (size > MIN_STEP_M**2) & (size > MIN_STEP_SIGMAS**2 * typical * expected) & ~gap
    offset = np.cumsum(np.vstack([np.zeros(3), np.where(is_step[:, None], moved, 0.0)]), axis=0)
    for fixes in np.split(np.arange(len(seconds)), np.flatnonzero(gap) + 1):
        wrong[fixes] = np.linalg.norm(offset[fixes] - np.median(offset[fixes], axis=0), axis=1) > MIN_STEP_M
    return wrong


def random_walk_of(seconds: np.ndarray, raw: np.ndarray) -> float:
    """Density q [m/sqrt(s)] of the random walk in residuals `raw` (n, 3) m at `seconds` (n,), beside white noise.
    Residuals that are NaN are ignored. The result is too small by a fifth, as the trajectory absorbs some of a walk.

    q follows from the structure function D(h) = <(r(t + h) - r(t))^2> = 2 sigma^2 + q^2 h, at the lags h of one fix and
    of STRUCTURE_LAG_S.
    """
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else STRUCTURE_LAG_S
    longer = max(2, round(STRUCTURE_LAG_S / step))
    if len(seconds) <= longer:
        return 0.0
    short, long = (float(np.nanmean((raw[k:] - raw[:-k]) ** 2)) for k in (1, longer))
    return float(np.sqrt(max(long - short, 0.0) / ((longer - 1) * step)))


def rms(x: np.ndarray) -> float:
    """Root mean square of all entries of `x`; 0 if `x` is empty."""
    return float(np.sqrt(np.mean(x**2))) if x.size else 0.0
