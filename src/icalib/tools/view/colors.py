"""Colours from values, for points."""

from __future__ import annotations

import numpy as np

# Five colours of matplotlib's viridis, whose brightness increases steadily, also for colour-blind people.
_STOPS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], np.float64)


def by_value(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """(N, 3) uint8 RGB of values (N,): dark at `low` and below, bright at `high` and above."""
    share = np.clip((values - low) / max(high - low, np.finfo(float).tiny), 0.0, 1.0)
    at = np.linspace(0.0, 1.0, len(_STOPS))
    return np.stack([np.interp(share, at, channel) for channel in _STOPS.T], axis=1).round().astype(np.uint8)


def rgb(*colors: str) -> np.ndarray:
    """(n, 3) uint8 RGB of colours in HTML notation, "#rrggbb"."""
    return np.array([list(bytes.fromhex(color[1:])) for color in colors], np.uint8)
