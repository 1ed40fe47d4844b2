"""Misfit that is concentrated at one time."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from icalib.estimate.estimate import Estimate

BINS, WINDOWS = 64, (3, 6, 9)  # bins of the recording, and of a window: a shock affects a few keyframes around it
AT_ONE_TIME = 0.5  # share of the misfit in one window
NEARLY_ALL = 0.9  # of the largest share of a window
LARGE = 3.0  # times the median chi^2 of a window; below it, the number of measurements may explain the difference


@dataclass(frozen=True)
class Disturbance:
    """A window with most of the misfit. start, end: [s, joined clock]; share: of the misfit; gain: its chi^2 beyond
    that of a usual window; sensors: those with large residuals in it."""

    start: float
    end: float
    share: float
    gain: float
    sensors: tuple[str, ...]


def disturbance(estimate: Estimate, misfit: float, misfits: Collection[str]) -> Disturbance | None:
    """The shortest window with nearly all that any window has of the `misfit` (chi^2 beyond the degrees of freedom) of
    the sensors `misfits`. None if that is less than half of it."""
    seconds = estimate.outcome.state.seconds
    edges = np.linspace(float(seconds[0]), float(seconds[-1]), BINS + 1)
    chi2 = {s: np.histogram(t, edges, weights=x)[0] for s, (t, x) in _chi2_over_time(estimate).items() if s in misfits}
    hits: list[Disturbance] = []
    for width in WINDOWS if misfit > 0.0 else ():
        beyond = {}
        for sensor, of_bins in chi2.items():
            usual = width * np.median(of_bins[of_bins > 0.0]) if of_bins.any() else 0.0
            window = np.convolve(of_bins, np.ones(width), "valid")
            beyond[sensor] = np.where(window > LARGE * usual, window - usual, 0.0)
        total = np.sum([np.zeros(BINS - width + 1), *beyond.values()], axis=0)
        k, gain = int(np.argmax(total)), float(total.max())
        sensors = tuple(s for s, excess in beyond.items() if excess[k] > 0.1 * gain)
        hits.append(Disturbance(float(edges[k]), float(edges[k + width]), min(gain / misfit, 1.0), gain, sensors))
    enough = max([AT_ONE_TIME, *(NEARLY_ALL * hit.share for hit in hits)])
    return next((hit for hit in hits if hit.share >= enough), None)


def _chi2_over_time(estimate: Estimate) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By sensor: times (n,) s on the joined clock and chi^2 (n,) of its residuals."""
    outcome = estimate.outcome
    rows = [r for key, f in outcome.problem.factors.items() for r in f.rows(outcome.residuals[key], outcome.state)]
    chi2: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {r.sensor: [] for r in rows}
    for r in rows:
        chi2[r.sensor].append((r.seconds, (r.weighted.astype(np.float64) ** 2).sum(axis=1)))
    return {
        s: (np.concatenate([t for t, _ in pairs]), np.concatenate([c for _, c in pairs])) for s, pairs in chi2.items()
    }
