"""The overlapping Allan deviation of readings (IEEE Std 952, annex C)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_PER_DECADE = 10
_STARTS_PER_CLUSTER = 16  # more overlapping pairs than these of one cluster tell nothing new
_FLICKER = np.sqrt(2.0 * np.log(2.0) / np.pi)  # 0.664: the flat part of the deviation over the bias instability


@dataclass(frozen=True)
class Deviation:
    """tau (m,) averaging times [s]; deviation (m, k) of k axes, in their unit; relative (m,) its relative standard
    deviation."""

    tau: np.ndarray
    deviation: np.ndarray
    relative: np.ndarray

    def instability(self) -> tuple[np.ndarray, np.ndarray]:
        """(k,) bias instability, the lowest deviation over 0.664, and the averaging time [s] where it is."""
        lowest = np.argmin(self.deviation, axis=0)
        return self.deviation[lowest, np.arange(self.deviation.shape[1])] / _FLICKER, self.tau[lowest]


def allan_deviation(readings: np.ndarray, period: float) -> Deviation:
    """Of readings (n, k), one every `period` seconds; averaging times up to a quarter of the recording."""
    return allan_deviation_of_all([readings], period)


def allan_deviation_of_all(stretches: Sequence[np.ndarray], period: float) -> Deviation:
    """Of stretches of readings (n, k), one every `period` seconds: neighbouring means are of one stretch, and all count
    alike. Averaging times up to a quarter of the longest stretch."""
    longest = max(1, max(map(len, stretches)) // 4)
    sizes = np.unique(np.round(np.geomspace(1, longest, 1 + round(_PER_DECADE * np.log10(longest)))).astype(np.int64))
    angles = [np.concatenate([np.zeros((1, r.shape[1])), np.cumsum(r - r.mean(axis=0), axis=0)]) for r in stretches]
    variance = np.array([_variance(angles, int(m)) for m in sizes])
    pairs = sum(np.maximum(len(r) / sizes - 1.0, 0.0) for r in stretches)
    return Deviation(sizes * period, np.sqrt(variance), 1.0 / np.sqrt(2.0 * np.maximum(pairs, 1.0)))


def _variance(angles: Sequence[np.ndarray], m: int) -> np.ndarray:
    """(k,) half the mean square of the difference of neighbouring means over m readings."""
    step = max(1, m // _STARTS_PER_CLUSTER)
    long = [angle for angle in angles if len(angle) > 2 * m]
    second = np.concatenate([a[2 * m :: step] - 2.0 * a[m:-m:step] + a[: -2 * m : step] for a in long])
    return (second**2).mean(axis=0) / (2.0 * m**2)


def model_variance(white: float, walk: float, tau: np.ndarray, period: float) -> np.ndarray:
    """Allan variance at `tau` [s] of white noise of density `white` and a random walk of density `walk`, sampled every
    `period` seconds: N^2 / tau + K^2 tau / 3 (1 + (period / tau)^2 / 2)."""
    return white**2 / tau + walk**2 * tau / 3.0 * (1.0 + 0.5 * (period / tau) ** 2)
