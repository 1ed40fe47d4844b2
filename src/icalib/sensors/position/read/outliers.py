"""Single fixes off the path of those before and after, and steps of the solution that last."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from icalib.geometry.cubic import lagrange_weights

NEAR = 51  # fixes about one, whose median distance is the usual one: motion and noise change
TIMES = 8.0  # the usual distance, some 10 standard deviations
LEAST_M = 0.05  # of fixes that are exact anything else would stand out
MOST = 0.1  # of all fixes: more are no single wrong ones
GAP_STEPS = 2.5  # a longer step is a gap, over which the motion may have changed
# The cubic through two fixes on each side weighs a neighbour by 2/3. A single wrong fix is thus seen by both neighbours
# at 2/3 of its size, a step that lasts by one of them at its whole size.
BESIDE = 0.35, 0.9
STEP_M, STEP_M_S2 = 0.3, 10.0  # a step of the solution is more than this, and than a motion can change by


def single_wrong(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(n,) which fixes p (n, 3) at t (n,) s are single wrong ones (Hampel's identifier on distances from a cubic)."""
    n = len(t)
    wrong = np.zeros(n, dtype=bool)
    if n < 9:
        return wrong
    far = _from_cubic(t, p)
    usual = np.maximum(median_filter(far, size=min(NEAR, n), mode="nearest"), np.median(far))
    limit = np.maximum(TIMES * usual, LEAST_M)
    beside = np.stack([np.roll(far, 1), np.roll(far, -1)]) / np.maximum(far, 1e-12)
    alone = (beside.min(axis=0) > BESIDE[0]) & (beside.max(axis=0) < BESIDE[1])
    wrong = (far > limit) & alone
    return wrong if wrong.mean() <= MOST else np.zeros(n, dtype=bool)


def _from_cubic(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(n,) m from the cubic through two fixes on each side, 0 at the ends and beside gaps."""
    n = len(t)
    i = np.arange(2, n - 2)
    knots = np.stack([i - 2, i - 1, i + 1, i + 2])
    predicted = np.einsum("kn,kni->ni", lagrange_weights(t[knots] - t[i]), p[knots])
    out = np.zeros(n)
    even = t[i + 2] - t[i - 2] < 4.0 * GAP_STEPS * np.median(np.diff(t))
    out[i] = np.where(even, np.linalg.norm(p[i] - predicted, axis=1), 0.0)
    return out


def steps(t: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (m,) of fixes before which p (n, 3) at t (n,) s steps, and sizes (m,) m."""
    dt, moved = np.diff(t), np.diff(p, axis=0)
    if len(dt) < 5:
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    beyond = np.linalg.norm(
        moved - dt[:, None] * median_filter(moved / dt[:, None], size=(5, 1), mode="nearest"), axis=1
    )
    usual = float(np.median(dt))
    limit = max(STEP_M, STEP_M_S2 * usual**2, TIMES * float(np.median(beyond)))
    found = np.flatnonzero((beyond > limit) & (dt < GAP_STEPS * usual))
    return found + 1, beyond[found]
