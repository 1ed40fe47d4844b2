"""Features that do not fit the motion of the camera: people, other vehicles, wrong matches."""

from __future__ import annotations

import numpy as np

from icalib.detection.tracking.epipolar import FEWEST, epipolar_errors

APART = (1, 4)  # images: each is compared with these before it
LENS_APART, LENS_PAIRS = 6, 8  # pairs of images that show how the lens bends
# At an image's corner; 0 is a lens without distortion, -1 one that sees half a sphere at its corners.
BENDS = (-1.2, -1.0, -0.8, -0.6, -0.45, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2)
TIMES_SIGMA, LEAST_PX = 4.0, 1.0  # no point is rejected for a smaller error
MOST_MISFITS = 1.0 / 3.0  # of a feature's comparisons: one that moves fails most, a single wrong match four


def moving_features(start: np.ndarray, feature: np.ndarray, uv: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    """(F,) bool, by number of the feature: whether it fails the epipolar geometry of most in many of its images.

    start (M + 1,), feature (N,), uv (N, 2) px as in `TrackStream`, features from 0 on; resolution (width, height).
    """
    n = int(feature.max(initial=-1)) + 1
    half_px = 0.5 * float(np.hypot(*resolution))
    xy = (uv - 0.5 * (np.array(resolution) - 1.0)) / half_px
    bend = _bend(start, feature, xy)
    tried, failed = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    for apart in APART:
        for k in range(apart, len(start) - 1):
            before, after = _common(start, feature, k - apart, k)
            if len(before) < FEWEST:
                continue
            wrong = misfits(xy[before], xy[after], bend, half_px, k)
            tried[feature[before]] += 1
            failed[feature[before[wrong]]] += 1
    return failed > MOST_MISFITS * tried


def misfits(p: np.ndarray, q: np.ndarray, bend: float, half_px: float, seed: int) -> np.ndarray:
    """(n,) bool: points p and q (n, 2) in two images that do not fit the epipolar geometry of most. Units are half the
    image's diagonal, half_px px, from its centre."""
    error, sigma = epipolar_errors(p, q, bend, seed)
    return error > max(TIMES_SIGMA * sigma, LEAST_PX / half_px)


def _bend(start: np.ndarray, feature: np.ndarray, xy: np.ndarray) -> float:
    """The bend of the lens with which most points fit best, in the mean over pairs of images."""
    firsts = np.unique(np.linspace(0, max(len(start) - 2 - LENS_APART, 0), LENS_PAIRS).astype(int))
    pairs = [_common(start, feature, int(k), int(k) + LENS_APART) for k in firsts if k + LENS_APART < len(start) - 1]
    return best_bend([(xy[p], xy[q]) for p, q in pairs if len(p) >= FEWEST])


def best_bend(pairs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """The bend with the least error in the mean over pairs of images, of points (n, 2) in each; 0 without pairs."""
    size = [sum(epipolar_errors(p, q, bend, 0)[1] for p, q in pairs) for bend in BENDS]
    return BENDS[int(np.argmin(size))] if pairs else 0.0


def _common(start: np.ndarray, feature: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the features that images i and j share, as each saw them."""
    own, other = feature[start[i] : start[i + 1]], feature[start[j] : start[j + 1]]
    _, p, q = np.intersect1d(own, other, assume_unique=True, return_indices=True)
    return p + start[i], q + start[j]
