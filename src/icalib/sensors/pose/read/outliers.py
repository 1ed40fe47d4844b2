"""Detects single outliers among poses (Hampel filter).

The distance of a pose from a cubic through two poses on each side is compared with the running median of such
distances. An outlier distorts the cubics of its neighbours as well, so that poses with large distances are only
candidates. Candidates and their neighbours are then compared with a cubic through other poses. A single outlier is far
from this cubic, and its neighbours are close to it. Where the motion changes suddenly, such as at the start of a robot,
all of them are far from it.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from icalib.geometry import so3
from icalib.geometry.vectors import lagrange_weights

_OUTLIER_MEDIANS = 6.0  # in median distances: about 9 standard deviations, which noise does not reach
_MEDIAN_WINDOW = 51  # window in poses, as motion and noise change over a recording
_MIN_OUTLIER = (1e-3, 1e-3)  # m, rad; least distance of an outlier, for poses without noise
# Largest distance of an outlier's neighbours, as a share of its distance, or of the limit.
_MAX_NEIGHBOUR_DISTANCE, _MAX_NEIGHBOUR_LIMIT = 0.2, 0.5
_MAX_CUBIC_STEPS = 12.0  # in median steps, from first to last of the four poses; longer cubics are inaccurate
_EVEN_VARIANCE = 1.0 + 34.0 / 36.0  # ratio of the variances of a distance and of a pose, for five evenly spaced poses
_MAX_OUTLIERS = 0.1  # share of all poses; if there are more, none is a single outlier


def single_outliers(seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(N,) bool: poses that are far from the motion between their neighbours, while the neighbours are not.

    All False with fewer than _MEDIAN_WINDOW poses, or if more than a share of _MAX_OUTLIERS were outliers."""
    n = len(seconds)
    wrong = np.zeros(n, dtype=bool)
    if n < _MEDIAN_WINDOW:
        return wrong
    poses, everything = (seconds, rotation, position), np.arange(n)
    far = _distances(poses, everything, everything)[0]
    usual = np.maximum(median_filter(far, size=(_MEDIAN_WINDOW, 1), mode="nearest"), np.median(far, axis=0))
    limit = np.maximum(_OUTLIER_MEDIANS * usual, _MIN_OUTLIER)
    candidate = (far > limit).any(axis=1)
    if not candidate.any() or candidate.sum() > 5.0 * _MAX_OUTLIERS * n:
        return wrong
    at = np.flatnonzero(candidate)
    rows = np.unique(np.clip(np.concatenate([at - 1, at, at + 1]), 0, n - 1))
    far[rows], size = _distances(poses, np.flatnonzero(~candidate), rows)
    limit[rows] *= size[:, None]
    beside = np.maximum(far[np.maximum(at - 1, 0)], far[np.minimum(at + 1, n - 1)])
    alone = beside <= np.maximum(_MAX_NEIGHBOUR_DISTANCE * far[at], _MAX_NEIGHBOUR_LIMIT * limit[at])
    wrong[at] = ((far[at] > limit[at]) & alone).any(axis=1)
    return wrong if wrong.sum() <= _MAX_OUTLIERS * n else np.zeros(n, dtype=bool)


def _distances(
    poses: tuple[np.ndarray, np.ndarray, np.ndarray], knots: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n, 2) [m, rad] of the poses with indices `rows` (n,) from a cubic through the two nearest of `knots`
    (m,) on each side. The distance is 0 if there are fewer knots. The second value (n,) is the ratio of their noise to
    that for evenly spaced poses."""
    t, R, p = poses
    left, right = np.searchsorted(knots, rows), np.searchsorted(knots, rows, side="right")
    has_knots = (left >= 2) & (right <= len(knots) - 2)
    left, right = np.clip(left, 2, len(knots)), np.clip(right, 0, len(knots) - 2)
    beside = knots[np.stack([left - 2, left - 1, right, right + 1])]
    has_knots &= t[beside[3]] - t[beside[0]] < _MAX_CUBIC_STEPS * np.median(np.diff(t))
    weight = np.where(
        has_knots, lagrange_weights(np.where(has_knots, t[beside] - t[rows], np.arange(1.0, 5.0)[:, None])), 0.0
    )
    off = p[rows] - np.einsum("kn,kni->ni", weight, p[beside])
    turns = [so3.log_many(np.ascontiguousarray(R[rows].transpose(0, 2, 1) @ R[k])) for k in beside]
    turned = np.einsum("kn,kni->ni", weight, np.stack(turns))
    far = np.stack([np.linalg.norm(off, axis=1), np.linalg.norm(turned, axis=1)], axis=1)
    return far * has_knots[:, None], np.sqrt((1.0 + (weight**2).sum(axis=0)) / _EVEN_VARIANCE)
