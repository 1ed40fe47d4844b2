"""What parts of a recording make of one another: half of it predicted by the other half, and the answer without each
part."""

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
class HeldOut:
    """Every other of `parts` parts of the recording makes one half; each half is predicted by the other.

    directions: of the calibration that both halves know; excess: by how much chi^2 of both halves is higher where they
    are predicted than where they took part; expected, spread: its mean and standard deviation for noise of the
    stated sizes. moved (G, B): how far the answer moves without each of the G parts [SI]; allowed (G, B): the formal
    standard deviation of that.
    """

    parts: int
    directions: int
    excess: float
    expected: float
    spread: float
    fits: tuple[PredictedFit, ...]
    moved: np.ndarray
    allowed: np.ndarray

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
        """(G, B) `moved` in units of `allowed`, each like a standard normal number where noise is all there is; NaN
        where nothing is allowed."""
        return self.moved / np.where(self.allowed > 0.0, self.allowed, np.nan)
