"""Outliers among fixes before estimation: single fixes off the path of their neighbours, and lasting steps of the
receiver's solution."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from icalib.geometry.vectors import lagrange_weights

MEDIAN_WINDOW_FIXES = 51  # of the moving median of distances, as motion and noise change
MAX_MEDIAN_DISTANCES = 8.0  # an outlier is this many median distances off, some 10 standard deviations
MIN_OUTLIER_M = 0.05  # smaller errors are no outliers, even among fixes without noise
MAX_OUTLIER_SHARE = 0.1  # of all fixes: if more look like outliers, none of them is rejected
MAX_GAP_STEPS = 2.5  # median intervals: a longer one is a gap, over which the motion may change
# The cubic through two fixes on each side weighs a neighbour by 2/3. An outlier thus moves the distances of both its
# neighbours by 2/3 of its size. A step that lasts moves that of one of them by its whole size.
NEIGHBOUR_SHARES = 0.35, 0.9
# A step of the solution is larger than this, and than a motion with this acceleration makes within an interval.
MIN_STEP_M, MIN_STEP_M_S2 = 0.3, 10.0


def single_wrong(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(n,) bool: which fixes p (n, 3) m at t (n,) s are single outliers, by Hampel's identifier on their distances from
    a cubic through their neighbours (Davies and Gather, 1993)."""
    n = len(t)
    wrong = np.zeros(n, dtype=bool)
    if n < 9:
        return wrong
    far = _from_cubic(t, p)
    typical = np.maximum(median_filter(far, size=min(MEDIAN_WINDOW_FIXES, n), mode="nearest"), np.median(far))
    limit = np.maximum(MAX_MEDIAN_DISTANCES * typical, MIN_OUTLIER_M)
    beside = np.stack([np.roll(far, 1), np.roll(far, -1)]) / np.maximum(far, 1e-12)
    alone = (beside.min(axis=0) > NEIGHBOUR_SHARES[0]) & (beside.max(axis=0) < NEIGHBOUR_SHARES[1])
    wrong = (far > limit) & alone
    return wrong if wrong.mean() <= MAX_OUTLIER_SHARE else np.zeros(n, dtype=bool)


def _from_cubic(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(n,) distances [m] from the cubic through two fixes on each side; 0 at the ends and beside gaps."""
    n = len(t)
    i = np.arange(2, n - 2)
    knots = np.stack([i - 2, i - 1, i + 1, i + 2])
    predicted = np.einsum("kn,kni->ni", lagrange_weights(t[knots] - t[i]), p[knots])
    out = np.zeros(n)
    even = t[i + 2] - t[i - 2] < 4.0 * MAX_GAP_STEPS * np.median(np.diff(t))
    out[i] = np.where(even, np.linalg.norm(p[i] - predicted, axis=1), 0.0)
    return out


def steps(t: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps of positions p (n, 3) m at t (n,) s that are not motion: numbers (m,) of the first fix after each, and the
    step vectors (m, 3) m."""
    dt, moved = np.diff(t), np.diff(p, axis=0)
    if len(dt) < 5:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    beyond = moved - dt[:, None] * median_filter(moved / dt[:, None], size=(5, 1), mode="nearest")
    typical, size = float(np.median(dt)), np.linalg.norm(beyond, axis=1)
    limit = max(MIN_STEP_M, MIN_STEP_M_S2 * typical**2, MAX_MEDIAN_DISTANCES * float(np.median(size)))
    before = np.flatnonzero((size > limit) & (dt < MAX_GAP_STEPS * typical))
    return before + 1, beyond[before]
