"""Misfit that is concentrated at one time."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from icalib.estimate.estimate import Estimate

BINS, WINDOW = 64, 3  # bins of the recording, and bins of a window: a shock affects a few keyframes around it
SHAKEN = ("gyroscope", "accelerometer", "corners")  # kinds of residuals that a knock on the rig enlarges
AT_ONE_TIME = 0.5  # share of the misfit in one window
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
    """The window with most of the `misfit` (chi^2 beyond the degrees of freedom) of the sensors `misfits`. None if no
    window has at least half of it."""
    state = estimate.outcome.state
    rows = {s: r for s, r in _chi2_over_time(estimate).items() if s in misfits}
    begin, end = float(state.seconds[0]), float(state.seconds[-1])
    edges = np.linspace(begin, end, BINS + 1)
    beyond = {}
    for sensor, (seconds, chi2) in rows.items():
        bin_chi2 = np.histogram(seconds, edges, weights=chi2)[0]
        usual = WINDOW * np.median(bin_chi2)
        window = np.convolve(bin_chi2, np.ones(WINDOW), "valid")
        beyond[sensor] = np.where(window > LARGE * usual, window - usual, 0.0)
    if not beyond or misfit <= 0.0:
        return None
    total = np.sum(list(beyond.values()), axis=0)
    k = int(np.argmax(total))
    share = float(total[k]) / misfit
    if share < AT_ONE_TIME:
        return None
    sensors = tuple(s for s, excess in beyond.items() if excess[k] > 0.1 * total[k])
    return Disturbance(float(edges[k]), float(edges[k + WINDOW]), min(share, 1.0), float(total[k]), sensors)


def _chi2_over_time(estimate: Estimate) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By sensor: times (n,) s on the joined clock and chi^2 (n,) of residuals of the kinds SHAKEN."""
    outcome = estimate.outcome
    factors = outcome.problem.factors.items()
    rows = [r for key, f in factors for r in f.rows(outcome.residuals[key], outcome.state) if r.kind in SHAKEN]
    chi2: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {r.sensor: [] for r in rows}
    for r in rows:
        chi2[r.sensor].append((r.seconds, (r.weighted.astype(np.float64) ** 2).sum(axis=1)))
    return {
        s: (np.concatenate([t for t, _ in pairs]), np.concatenate([c for _, c in pairs])) for s, pairs in chi2.items()
    }
