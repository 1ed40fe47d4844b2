"""Two-fold cross-validation of a calibration, and how far it shifts without each segment of the recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SIGNIFICANT = 3.0  # standard deviations of what noise does: fewer are chance


@dataclass(frozen=True)
class PredictedFit:
    """One kind of residual in half the recording: chi^2, and RMS in `unit` where it has one, with the calibration of
    both halves (`inside`) and with that of the other half alone (`outside`), the motion at its best each time."""

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
    """Two-fold cross-validation: every other of `segments` segments of the recording makes one half (fold).

    directions: of the calibration, that both halves determine. excess: chi^2 of both halves with the calibration of the
    other half, minus that with the calibration of both. expected, spread: mean and standard deviation of `excess` for
    noise of the stated sizes. shift (G, B): change of the calibration without each of the G segments [SI]; shift_sigma
    (G, B): its formal standard deviation.
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
        """By which the formal standard deviations are too small, near 1 where noise is all there is."""
        return float(np.sqrt(max(self.excess, 0.0) / self.expected))

    @property
    def optimistic(self) -> bool:
        """Whether the formal standard deviations are too small, chance aside."""
        return self.excess > self.expected + SIGNIFICANT * self.spread

    @property
    def pessimistic(self) -> bool:
        """Whether they are too large, chance aside."""
        return self.excess < self.expected - SIGNIFICANT * self.spread

    @property
    def whitened(self) -> np.ndarray:
        """(G, B) `shift` over `shift_sigma`: standard normal if noise is the only error; NaN where the sigma is 0."""
        return self.shift / np.where(self.shift_sigma > 0.0, self.shift_sigma, np.nan)
