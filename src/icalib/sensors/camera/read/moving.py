"""Detects features that do not fit the motion of the camera: people, other vehicles, wrong matches."""

from __future__ import annotations

import numpy as np

from icalib.detection.tracking.epipolar import FEWEST_MATCHED_POINTS, epipolar_errors
from icalib.sensors.camera.stream import shared_rows

COMPARED_IMAGES = (1, 4)  # each image is compared with those that are this many images earlier
LENS_APART, LENS_PAIRS = 6, 8  # images apart, and number, of the pairs from which the distortion is estimated
# Candidates of the distortion, for points in units of half the image diagonal; 0 is a lens without distortion, -1 one
# that sees half a sphere at the image corners.
LAMBDAS = (-1.2, -1.0, -0.8, -0.6, -0.45, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2)
# standard deviations, and px, the larger of both: error above which a point does not fit
TIMES_SIGMA, LEAST_PX = 4.0, 1.0
# share of a feature's comparisons that may fail: a moving point fails most, a single wrong match up to four
MOST_MISFIT_SHARE = 1.0 / 3.0


def moving_features(start: np.ndarray, feature: np.ndarray, uv: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    """(F,) bool, by feature number: whether it does not fit the epipolar geometry of most points in more than a third
    of its comparisons.

    start (M + 1,), feature (N,), uv (N, 2) px as in `TrackStream`, features numbered from 0; resolution (width,
    height).
    """
    n = int(feature.max(initial=-1)) + 1
    xy, half_px = from_centre(uv, resolution)
    lam = _lambda(start, feature, xy)
    tried, failed = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    for apart in COMPARED_IMAGES:
        for k in range(apart, len(start) - 1):
            before, after = shared_rows(start, feature, k - apart, k)
            if len(before) < FEWEST_MATCHED_POINTS:
                continue
            wrong, _ = misfits(xy[before], xy[after], lam, half_px, k)
            tried[feature[before]] += 1
            failed[feature[before[wrong]]] += 1
    return failed > MOST_MISFIT_SHARE * tried


def from_centre(uv: np.ndarray, resolution: tuple[int, int]) -> tuple[np.ndarray, float]:
    """Pixels uv (n, 2) relative to the image centre, in units of half the image diagonal; and this unit [px]."""
    half_px = 0.5 * float(np.hypot(*resolution))
    return (uv - 0.5 * (np.array(resolution) - 1.0)) / half_px, half_px


def misfits(p: np.ndarray, q: np.ndarray, lam: float, half_px: float, seed: int) -> tuple[np.ndarray, float]:
    """(n,) bool: points p and q (n, 2), as of `from_centre`, that do not fit the epipolar geometry of most; and the
    standard deviation [px] of the errors."""
    error, sigma = epipolar_errors(p, q, lam, seed)
    return error > max(TIMES_SIGMA * sigma, LEAST_PX / half_px), sigma * half_px


def _lambda(start: np.ndarray, feature: np.ndarray, xy: np.ndarray) -> float:
    """The distortion (lambda of the division model) with the least mean error over LENS_PAIRS pairs of images."""
    firsts = np.unique(np.linspace(0, max(len(start) - 2 - LENS_APART, 0), LENS_PAIRS).astype(int))
    pairs = [
        shared_rows(start, feature, int(k), int(k) + LENS_APART) for k in firsts if k + LENS_APART < len(start) - 1
    ]
    return best_lambda([(xy[p], xy[q]) for p, q in pairs if len(p) >= FEWEST_MATCHED_POINTS])


def best_lambda(pairs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """The distortion with the least mean error over `pairs` of point arrays (n, 2) in two images; 0 without pairs."""
    size = [sum(epipolar_errors(p, q, lam, 0)[1] for p, q in pairs) for lam in LAMBDAS]
    return LAMBDAS[int(np.argmin(size))] if pairs else 0.0
