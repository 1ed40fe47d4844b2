"""Parts of the formal variances by their source, and empirical factors on each part."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, stdtrit

from icalib.estimate.estimate import Estimate
from icalib.estimate.residual_statistics.image_regions import cluster_covariances
from icalib.estimate.residual_statistics.inflation import noise_variance, spread_variance
from icalib.estimate.residual_statistics.segments import Segments
from icalib.observability.determination import Determined

ENOUGH_SEGMENTS = 8  # segments; with as many, Student's t differs from the normal distribution by 8 % at most


class VarianceParts(NamedTuple):
    """Shares of the formal variances by source, and how much larger each part is in truth.

    noise, prior (B,): shares of the measurement noise and of errors of nuisance parameters; errors of the initial guess
    along unobservable directions contribute the rest. ratio (B,): empirical over formal standard deviation of the noise
    part. weight: factor on the standard deviation of the prior part, see `Determined.inflation`.
    """

    noise: np.ndarray
    prior: np.ndarray
    ratio: np.ndarray
    weight: float

    @classmethod
    def of(cls, determined: Determined, segments: Segments | None) -> VarianceParts:
        """Variance shares and empirical factors of the estimate `determined`. segments: None if the recording is not
        split."""
        estimate = determined.estimate
        variance, guess = np.diag(determined.covariance), (determined.shifts**2).sum(axis=0)
        prior = np.clip(determined.prior_variance(), 0.0, variance - guess)
        formal = noise_variance(estimate.problem, estimate.outcome)
        empirical = _empirical_variance(estimate, segments, formal)
        ratio = np.sqrt(np.divide(empirical, formal, out=np.ones_like(formal), where=formal > 0.0))  # 0: fixed
        return cls(np.maximum(1.0 - (guess + prior) / variance, 0.0), prior / variance, ratio, determined.inflation)

    def pooled(self, columns: np.ndarray) -> float:
        """Root mean square of the ratio over `columns`, weighted by the noise share of each."""
        weights = self.noise[columns]
        total = float(weights.sum())
        return float(np.sqrt(weights @ self.ratio[columns] ** 2 / total)) if total > 0.0 else 1.0

    def factor(self, columns: np.ndarray, overall: float) -> np.ndarray:
        """(n,) empirical factors on the formal standard deviations of a group with n `columns`.

        Each part of the variance has its own factor. The noise part has the square of the larger of two ratios: the
        pooled ratio of the group and the `overall` one, at least 1. The prior part has the square of `weight`, and the
        part from the initial guess has 1.
        """
        noise_factor = max(1.0, self.pooled(columns), overall)
        noise, prior = self.noise[columns], self.prior[columns]
        return np.sqrt(noise_factor**2 * noise + self.weight**2 * prior + np.maximum(1.0 - noise - prior, 0.0))


def _empirical_variance(estimate: Estimate, segments: Segments | None, white: np.ndarray) -> np.ndarray:
    """(B,) variances: the larger of the scatter over segments and over feature tracks. The excess of cluster-robust
    variances over `white` (B,) is added, for image and target regions. Returns `white` without segments and tracks."""
    if segments is None and not estimate.problem.ties_distant_keyframes:
        return white
    clusters = cluster_covariances(estimate.problem, estimate.outcome)
    spread = white if clusters.tracks is None else np.diag(clusters.tracks)
    if segments is not None:
        over_segments = few_factor(segments.count) ** 2 * spread_variance(estimate.outcome, segments, white)
        spread = over_segments if clusters.tracks is None else np.maximum(spread, over_segments)
    return spread + sum(np.maximum(np.diag(V) - white, 0.0) for V in clusters.regions)


def few_factor(segments: int) -> float:
    """Factor on a standard deviation from the scatter of few segments, so that 68 % of errors lie within. It is a
    quantile of Student's t with segments - 1 degrees of freedom."""
    return float(stdtrit(segments - 1, ndtr(1.0))) if segments < ENOUGH_SEGMENTS else 1.0
