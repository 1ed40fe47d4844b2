"""Points on the robot itself, or on the lens: they stay in place in the image while the scene moves through it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

SCENE_MOVES_PX = 10.0  # over a track's life, all points alike, as they do where the camera turns
STAYS_PX = 1.0  # what a point in place moves at most, by noise and vibration
NEAR_ROBOT_PX = 64.0  # a track that does not move so near to a point in place is in place, too


def stay_in_place(start: np.ndarray, feature: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Whether each feature (F,) stays in place in the image, from its first view to its last, while the scene moves.

    start (M + 1,), feature (N,) and uv (N, 2) as in `TrackStream`, features numbered from 0. The image moves by the
    median motion of its points, each component by itself: a turn of the camera moves all points alike, while a camera
    that moves forwards has a median near zero, and points straight ahead are not taken for the robot's. Tracks too
    short to tell are in place where others are.
    """
    n = int(feature.max(initial=-1)) + 1
    image = np.repeat(np.arange(len(start) - 1), np.diff(start))
    order = np.lexsort((image, feature))
    follows = (np.diff(feature[order]) == 0) & (np.diff(image[order]) == 1)
    before, after = order[:-1][follows], order[1:][follows]
    travelled, flow, into = np.zeros((len(start) - 1, 2)), uv[after] - uv[before], image[after]
    for k in np.unique(into):
        travelled[k] = np.median(flow[into == k], axis=0)
    travelled = np.cumsum(travelled, axis=0)
    first, last = _ends(feature[order], n)
    moved = np.linalg.norm((travelled[image[order[last]]] - travelled[image[order[first]]]), axis=1)
    low, high = np.full((n, 2), np.inf), np.full((n, 2), -np.inf)
    np.minimum.at(low, feature, uv)
    np.maximum.at(high, feature, uv)
    stays = np.linalg.norm(np.where(np.isfinite(high), high - low, np.inf), axis=1) < STAYS_PX
    in_place = stays & (moved > SCENE_MOVES_PX)
    if in_place.any():
        still = np.flatnonzero(stays)
        distance, _ = KDTree(low[in_place]).query(low[still])
        in_place[still[distance < NEAR_ROBOT_PX]] = True
    return in_place


def _ends(feature: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """(n,) the first and the last row of each feature in feature (N,), which is sorted; row 0 for one without rows."""
    begin, end = np.searchsorted(feature, np.arange(n)), np.searchsorted(feature, np.arange(n), side="right")
    seen = end > begin
    return np.where(seen, begin, 0), np.where(seen, end - 1, 0)
