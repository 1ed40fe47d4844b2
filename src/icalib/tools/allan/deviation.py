"""The overlapping Allan deviation of readings (IEEE Std 952, annex C)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_PER_DECADE = 10  # averaging times
_STARTS_PER_CLUSTER = 16  # overlapping pairs per averaging time: more of them add no information
_FLICKER = np.sqrt(2.0 * np.log(2.0) / np.pi)  # 0.664: ratio of the flat part of the deviation to the bias instability


@dataclass(frozen=True)
class Deviation:
    """Allan deviations of k axes. tau (m,): averaging times [s]; deviation (m, k), in the unit of the readings;
    relative (m,): relative standard deviation of `deviation`."""

    tau: np.ndarray
    deviation: np.ndarray
    relative: np.ndarray

    def instability(self) -> tuple[np.ndarray, np.ndarray]:
        """Bias instability (k,), the lowest deviation over 0.664, in the unit of the readings; and its averaging time
        (k,) [s]."""
        lowest = np.argmin(self.deviation, axis=0)
        return self.deviation[lowest, np.arange(self.deviation.shape[1])] / _FLICKER, self.tau[lowest]


def allan_deviation(readings: np.ndarray, period: float) -> Deviation:
    """Allan deviation of readings (n, k), one every `period` seconds; averaging times up to a quarter of the
    recording."""
    return allan_deviation_of_all([readings], period)


def allan_deviation_of_all(stretches: Sequence[np.ndarray], period: float) -> Deviation:
    """Allan deviation of several stretches of readings (n, k), one every `period` seconds. No difference of means spans
    two stretches, and all differences have equal weight. Averaging times are up to a quarter of the longest stretch."""
    longest = max(1, max(map(len, stretches)) // 4)
    sizes = np.unique(np.round(np.geomspace(1, longest, 1 + round(_PER_DECADE * np.log10(longest)))).astype(np.int64))
    angles = [np.concatenate([np.zeros((1, r.shape[1])), np.cumsum(r - r.mean(axis=0), axis=0)]) for r in stretches]
    variance = np.array([_variance(angles, int(m)) for m in sizes])
    pairs = sum(np.maximum(len(r) / sizes - 1.0, 0.0) for r in stretches)
    return Deviation(sizes * period, np.sqrt(variance), 1.0 / np.sqrt(2.0 * np.maximum(pairs, 1.0)))


def _variance(angles: Sequence[np.ndarray], m: int) -> np.ndarray:
    """(k,) Allan variance: half the mean square of the differences between successive means of m readings. angles:
    cumulative sums (n + 1, k) of each stretch."""
    step = max(1, m // _STARTS_PER_CLUSTER)
    long = [angle for angle in angles if len(angle) > 2 * m]
    second = np.concatenate([a[2 * m :: step] - 2.0 * a[m:-m:step] + a[: -2 * m : step] for a in long])
    return (second**2).mean(axis=0) / (2.0 * m**2)


def model_variance(white: float, walk: float, tau: np.ndarray, period: float) -> np.ndarray:
    """Allan variance at `tau` [s] of white noise of density N = `white` and a random walk of density K = `walk`,
    sampled every `period` seconds: N^2 / tau + K^2 tau / 3 (1 + (period / tau)^2 / 2)."""
    return white**2 / tau + walk**2 * tau / 3.0 * (1.0 + 0.5 * (period / tau) ** 2)
