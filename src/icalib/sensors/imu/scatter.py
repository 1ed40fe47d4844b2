"""Noise density that the readings of an IMU show by themselves."""

from __future__ import annotations

from math import comb

import numpy as np

from icalib.data.stamps.clocks import usual_step

ORDER = 6  # of the differences: weaken motion at a tenth of the sampling rate 500 times, slower motion by more
WINDOW = 100  # differences of a window
QUIET = 0.25  # quantile of the windows: most vibration is in others


def quiet_scatter(seconds: np.ndarray, readings: np.ndarray) -> float:
    """Noise density of `readings` (N, 3) at `seconds` (N,) in the quietest windows; NaN where fewer than ten windows
    have readings without a gap.

    Differences of order n of white noise have comb(2 n, n) times its variance, and hardly any of smooth motion. A
    filter in the IMU weakens fast noise, so that the density at the frequencies of motion is this one or larger.
    Vibration in all windows counts as noise. Unit: that of the readings over sqrt(Hz).
    """
    if len(seconds) < 10 * WINDOW + ORDER:
        return np.nan
    step = usual_step(seconds)
    late = np.concatenate([[0], np.cumsum(np.diff(seconds) > 2.0 * step)])
    differences = np.diff(readings, ORDER, axis=0)[late[ORDER:] == late[:-ORDER]]
    count = len(differences) // WINDOW
    if count < 10:
        return np.nan
    squares = differences[: count * WINDOW].reshape(count, WINDOW, -1) ** 2 / comb(2 * ORDER, ORDER)
    return float(np.sqrt((np.quantile(squares.mean(axis=1), QUIET, axis=0)).mean() * step))
