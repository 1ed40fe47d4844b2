"""Detects points on the robot itself, or on the lens: they stay in place in the image while the scene moves."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

SCENE_MOVES_PX = 10.0  # least motion of the scene over a track, common to all points, as if the camera turns
STAYS_PX = 1.0  # largest motion of a point in place, by noise and vibration
NEAR_ROBOT_PX = 64.0  # a short track without motion is in place, too, if it is this near to a point in place


def stay_in_place(start: np.ndarray, feature: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(F,) whether each feature stays in place in the image, from its first view to its last, while the scene moves.

    start (M + 1,), feature (N,) and uv (N, 2) px as in `TrackStream`, features numbered from 0. The motion of the scene
    is the median motion of the points, for each component. A rotation of the camera moves all points alike. Forward
    motion has a median near zero, so that points straight ahead are not mistaken for points on the robot. Tracks that
    are too short to decide are in place if they are near others in place.
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
    """(n,) the first and the last row of each feature in the sorted feature (N,); row 0 for a feature without rows."""
    begin, end = np.searchsorted(feature, np.arange(n)), np.searchsorted(feature, np.arange(n), side="right")
    has_rows = end > begin
    return np.where(has_rows, begin, 0), np.where(has_rows, end - 1, 0)
