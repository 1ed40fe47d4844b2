"""Two-fold cross-validation of a calibration, and its change if one segment of the recording is left out
(jackknife)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SIGNIFICANT = 3.0  # standard deviations of the statistic under pure noise; smaller deviations count as chance


@dataclass(frozen=True)
class PredictedFit:
    """Fit of one kind of residual in one half (fold) of the recording, with the trajectory optimised each time. inside:
    with the calibration from both halves. outside: with the calibration from the other half alone. chi2: chi^2; rms: in
    `unit`, None for residuals without a unit."""

    sensor: str
    kind: str
    count: int
    chi2_inside: float
    chi2_outside: float
    rms_inside: float | None = None
    rms_outside: float | None = None
    unit: str = ""


@dataclass(frozen=True)
class CrossValidation:
    """Two-fold cross-validation: the odd and the even ones of `segments` segments make the two halves (folds).

    directions: number of directions of the calibration that both halves determine. excess: chi^2 of both halves, each
    with the calibration of the other half, minus that with the calibration of both. expected, spread: mean and standard
    deviation of `excess` for noise of the stated sizes. shift (G, B): change of the calibration without each of the G
    segments [SI]; shift_sigma (G, B): its formal standard deviation.
    """

    segments: int
    directions: int
    excess: float
    expected: float
    spread: float
    fits: tuple[PredictedFit, ...]
    shift: np.ndarray
    shift_sigma: np.ndarray

    @property
    def factor(self) -> float:
        """Factor by which the formal standard deviations are too small; near 1 if noise of the stated sizes is the only
        error."""
        return float(np.sqrt(max(self.excess, 0.0) / self.expected))

    @property
    def optimistic(self) -> bool:
        """Whether the formal standard deviations are significantly too small."""
        return self.excess > self.expected + SIGNIFICANT * self.spread

    @property
    def pessimistic(self) -> bool:
        """Whether the formal standard deviations are significantly too large."""
        return self.excess < self.expected - SIGNIFICANT * self.spread

    @property
    def whitened(self) -> np.ndarray:
        """(G, B) `shift` over `shift_sigma`: standard normal if noise is the only error; NaN if the sigma is 0."""
        return self.shift / np.where(self.shift_sigma > 0.0, self.shift_sigma, np.nan)
