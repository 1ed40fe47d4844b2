"""Mean angular rates of noisy rotations, over windows so long that noise is a small part of the rates."""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3
from icalib.geometry.vectors import MEDIAN_NORM

MAX_RATE_NOISE_SHARE = 0.15  # noise over variation of the rates: with more, rates of two sensors hardly correlate
WINDOW_FACTORS = (1.5, 2.5, 4.0, 6.0)  # longer windows, in units of the shortest: 0.15 to 0.6 s for poses
MAX_WINDOW_STRETCH = 2.5  # actual length over nominal length of a window: more spans a gap
THIRD_DIFFERENCE_SIGMA = np.sqrt(20.0)  # standard deviation of x_3 - 3 x_2 + 3 x_1 - x_0, for white x of variance 1


def rotation_noise(rotation: np.ndarray) -> float:
    """Standard deviation [rad] of white noise about each axis of rotations (n, 3, 3). It uses third differences, in
    which smooth motion cancels, and their median, which is robust to outliers."""
    if len(rotation) < 4:
        return 0.0
    turn = so3.log_many(np.ascontiguousarray(rotation[:-1].transpose(0, 2, 1) @ rotation[1:]))
    third = turn[2:] - 2.0 * turn[1:-1] + turn[:-2]
    return float(np.median(np.linalg.norm(third, axis=1))) / (MEDIAN_NORM * THIRD_DIFFERENCE_SIGMA)


def rate_window(seconds: np.ndarray, rotation: np.ndarray, shortest: float, longest_step: float) -> float:
    """The shortest window [s] over which the noise of the rates is below MAX_RATE_NOISE_SHARE of their variation. If
    there is none, the window with the smallest share.

    rotation (n, 3, 3) at seconds (n,); shortest: the first window that is tried [s]; longest_step: see `window_rates`.
    """
    noise, shares = rotation_noise(rotation), []
    windows = [shortest, *(shortest * k for k in WINDOW_FACTORS)]
    for window in windows:
        _, _, rate = window_rates(seconds, rotation, window, longest_step)
        if len(rate) < 2:
            break
        error = np.sqrt(2.0 * 3.0) * noise / window
        varies = float(np.mean(((rate - rate.mean(axis=0)) ** 2).sum(axis=1)))
        shares.append(error / np.sqrt(max(varies - error**2, (0.1 * error) ** 2, 1e-12)))
        if shares[-1] < MAX_RATE_NOISE_SHARE:
            break
    return windows[int(np.argmin(shares))] if shares else shortest


def window_rates(
    seconds: np.ndarray, rotation: np.ndarray, window: float, longest_step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean rates over windows of about `window` s, one from each pose: indices (m,) of first and last pose, and rates
    (m, 3) rad/s in axes of the first. A window over a step longer than `longest_step` [s] is left out, unless all
    windows are long."""
    a = np.arange(len(seconds))
    b = np.searchsorted(seconds, seconds + window - 1e-9)
    a, b = a[b < len(seconds)], b[b < len(seconds)]
    a, b = pairs_within(seconds, a, b, max(longest_step, MAX_WINDOW_STRETCH * window))
    turn = so3.log_many(np.ascontiguousarray(rotation[a].transpose(0, 2, 1) @ rotation[b]))
    return a, b, turn / (seconds[b] - seconds[a])[:, None]


def pairs_within(seconds: np.ndarray, i: np.ndarray, j: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """The pairs of instants i, j (n,), indices of increasing `seconds` (N,), that are at most `longest` s apart."""
    near = seconds[j] - seconds[i] <= longest
    return i[near], j[near]
