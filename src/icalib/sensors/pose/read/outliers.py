"""Single wrong poses, told from a cubic through two poses on each side, in units of how far all are from it (Hampel).

A wrong pose bends the cubics of its neighbours, too. Therefore poses that are far are only suspects: each of them, and
the poses beside it, is then compared with the cubic through poses that are none. A single wrong pose is far from that
and those beside it are not; about a kink of the motion itself, as of a robot that starts, all of them are.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from icalib.geometry import so3
from icalib.geometry.cubic import lagrange_weights

_TIMES = 6.0  # the median distance: about 9 of its standard deviations, which noise does not reach
_NEAR = 51  # poses about it, of which the median is taken: motion and noise change
_LEAST = (1e-3, 1e-3)  # m, rad: of poses without noise anything else would stand out
_BESIDE, _BESIDE_TIMES = 0.2, 0.5  # of the distance, or of the limit: as far may the poses beside a wrong one be
_LONGEST_STEPS = 12.0  # usual ones, from the first of the four poses to the last: a gap shows nothing
_EVEN = 1.0 + 34.0 / 36.0  # variance of a distance over that of a pose, where all five are evenly spaced
_MOST = 0.1  # of all poses: more are no single wrong ones


def single_wrong(seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(N,) which poses are single wrong ones."""
    n = len(seconds)
    wrong = np.zeros(n, dtype=bool)
    if n < _NEAR:
        return wrong
    poses, everything = (seconds, rotation, position), np.arange(n)
    far = _distances(poses, everything, everything)[0]
    usual = np.maximum(median_filter(far, size=(_NEAR, 1), mode="nearest"), np.median(far, axis=0))
    limit = np.maximum(_TIMES * usual, _LEAST)
    suspect = (far > limit).any(axis=1)
    if not suspect.any() or suspect.sum() > 5.0 * _MOST * n:
        return wrong
    at = np.flatnonzero(suspect)
    asked = np.unique(np.clip(np.concatenate([at - 1, at, at + 1]), 0, n - 1))
    far[asked], size = _distances(poses, np.flatnonzero(~suspect), asked)
    limit[asked] *= size[:, None]
    beside = np.maximum(far[np.maximum(at - 1, 0)], far[np.minimum(at + 1, n - 1)])
    alone = beside <= np.maximum(_BESIDE * far[at], _BESIDE_TIMES * limit[at])
    wrong[at] = ((far[at] > limit[at]) & alone).any(axis=1)
    return wrong if wrong.sum() <= _MOST * n else np.zeros(n, dtype=bool)


def _distances(
    poses: tuple[np.ndarray, np.ndarray, np.ndarray], knots: np.ndarray, asked: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) m and rad of the poses numbered `asked` (n,) from the cubic through the nearest two of `knots` (m,) on
    each side, but not themselves, 0 where there are none; and how much larger noise makes it than of evenly spaced
    poses."""
    t, R, p = poses
    left, right = np.searchsorted(knots, asked), np.searchsorted(knots, asked, side="right")
    found = (left >= 2) & (right <= len(knots) - 2)
    left, right = np.clip(left, 2, len(knots)), np.clip(right, 0, len(knots) - 2)
    beside = knots[np.stack([left - 2, left - 1, right, right + 1])]
    found &= t[beside[3]] - t[beside[0]] < _LONGEST_STEPS * np.median(np.diff(t))
    weight = np.where(found, lagrange_weights(np.where(found, t[beside] - t[asked], np.arange(1.0, 5.0)[:, None])), 0.0)
    off = p[asked] - np.einsum("kn,kni->ni", weight, p[beside])
    turns = [so3.log_many(np.ascontiguousarray(R[asked].transpose(0, 2, 1) @ R[k])) for k in beside]
    turned = np.einsum("kn,kni->ni", weight, np.stack(turns))
    far = np.stack([np.linalg.norm(off, axis=1), np.linalg.norm(turned, axis=1)], axis=1)
    return far * found[:, None], np.sqrt((1.0 + (weight**2).sum(axis=0)) / _EVEN)
