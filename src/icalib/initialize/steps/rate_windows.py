"""Mean angular rates of noisy poses: over windows so long that noise has little part in them."""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3

MAX_RATE_NOISE_SHARE = 0.15  # of the rates: with more the sizes of two sensors' rates are hardly alike
WINDOW_FACTORS = (1.5, 2.5, 4.0, 6.0)  # windows that are tried, times the shortest: 0.15 to 0.6 s of poses
MAX_WINDOW_STRETCH = 2.5  # windows, at most: poses further apart are those of a gap
THIRD_DIFFERENCE_SIGMA = np.sqrt(20.0)  # the standard deviation of x_3 - 3 x_2 + 3 x_1 - x_0, of white x
NORM_MEDIAN = 1.538  # of three standard normal components


def rotation_noise(rotation: np.ndarray) -> float:
    """Standard deviation [rad] of each axis of rotations (n, 3, 3), white from one to the next: by third differences,
    in which smooth motion hardly counts, and their median, in which single bad ones do not."""
    if len(rotation) < 4:
        return 0.0
    turn = so3.log_many(np.ascontiguousarray(rotation[:-1].transpose(0, 2, 1) @ rotation[1:]))
    third = turn[2:] - 2.0 * turn[1:-1] + turn[:-2]
    return float(np.median(np.linalg.norm(third, axis=1))) / (NORM_MEDIAN * THIRD_DIFFERENCE_SIGMA)


def rate_window(seconds: np.ndarray, rotation: np.ndarray, shortest: float, longest_step: float) -> float:
    """The window [s], no shorter than `shortest`, over which rates of rotations (n, 3, 3) at seconds (n,) hold less
    noise than LARGEST_NOISE of what the rates vary by; if none does, the one with least noise in that."""
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
    """Indices (m,) of first and last pose of windows about so long [s], one from each pose; across steps longer than
    longest_step [s] there is none, unless the window is long itself. And the mean rates (m, 3)
    [rad/s] in axes of the first."""
    a = np.arange(len(seconds))
    b = np.searchsorted(seconds, seconds + window - 1e-9)
    a, b = a[b < len(seconds)], b[b < len(seconds)]
    near = seconds[b] - seconds[a] <= max(longest_step, MAX_WINDOW_STRETCH * window)
    a, b = a[near], b[near]
    turn = so3.log_many(np.ascontiguousarray(rotation[a].transpose(0, 2, 1) @ rotation[b]))
    return a, b, turn / (seconds[b] - seconds[a])[:, None]
