"""Rejects corners with large residuals, unless their neighbours in the image plane have similar ones.

A lens that its model cannot follow makes large residuals near the border of the image. Neighbouring corners of all
images have similar ones, and they decrease towards the middle. A gross outlier is isolated. A corner with a large
residual is suspect. It is kept where a chain of neighbours with similar residuals leads from it to a corner that is
not suspect.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from icalib.optim.medians import grouped_quantiles, largest_normal
from icalib.rig import Settings
from icalib.sensors.camera.corner_factor import CornerFactor, CornerOutput

N_NEIGHBOURS = 12  # nearest corners; with twice as many, small outliers near the border find similar ones by chance
# Corners that are not suspect, among which neighbours are searched: one for every 4 x 4 px of 752 x 480. With fewer,
# neighbours are farther away; more take time and memory.
MAX_UNSUSPECT_CORNERS = 20_000
CORNERS_PER_TAG = 4  # in one image they are no neighbours: all corners of a misidentified tag err alike
SIMILAR_RATIO = 0.7  # largest distance of two similar residuals over their length; at 1 zero would be similar


def inliers(factor: CornerFactor, out: CornerOutput, settings: Settings) -> np.ndarray:
    """(N,) bool: corners that are not rejected. Corners outside the range of the lens model are rejected, too.

    A corner is suspect when its residual is larger than `outlier_min_px`, and larger than the mean of normal errors
    plus `outlier_std` standard deviations. Both follow from the median of its image or that of all images, whichever is
    larger (lengths of normal errors have Rayleigh's distribution). All are kept if `outlier_std` is 0.
    """
    if settings.outlier_std <= 0.0:
        return np.ones(len(out.root), dtype=bool)
    used = np.flatnonzero((out.root > 0.0) | ~factor.keep)  # rejected corners are tested again: they may fit now
    kept = np.zeros(len(out.root), dtype=bool)
    kept[used] = ~rejected(factor, used, out.residual[used], settings)
    return kept


def rejected(factor: CornerFactor, rows: np.ndarray, residual: np.ndarray, settings: Settings) -> np.ndarray:
    """(n,) bool: the corners `rows` (n,) int of the stream that their residuals (n, 2) [px] reject, as of `inliers`."""
    if settings.outlier_std <= 0.0:
        return np.zeros(len(rows), dtype=bool)
    # In double precision: where the IMU has a gap, poses may project points to 1e20 px, whose squares overflow.
    residual = residual.astype(np.float64)
    stream, size = factor.stream, np.linalg.norm(residual, axis=1)
    image = stream.image[rows]
    usual = grouped_quantiles(size, image, len(stream.stamps_ns), 0.5)
    if len(size):
        usual = np.maximum(usual, np.median(size))
    limit = np.maximum(largest_normal(settings.outlier_std, 0.5) * usual, settings.outlier_min_px)
    suspect = size > limit[image]
    if settings.loss == "none" or not suspect.any():  # the influence of a kept corner would not be bounded
        return suspect
    some, number = _with_neighbours(suspect), factor.bodies.target.tag_number
    tag = image[some] * (1 + number.max(initial=0)) + number[stream.point[rows[some]]]
    suspect[some] = isolated(stream.uv[rows[some]], residual[some], suspect[some], tag)
    return suspect


def _with_neighbours(suspect: np.ndarray) -> np.ndarray:
    """(n,) int, in order: all `suspect` (N,) corners, and of the others MAX_UNSUSPECT_CORNERS at most, evenly drawn."""
    others = np.flatnonzero(~suspect)
    return np.union1d(np.flatnonzero(suspect), others[:: 1 + len(others) // MAX_UNSUSPECT_CORNERS])


def isolated(uv: np.ndarray, residual: np.ndarray, suspect: np.ndarray, tag: np.ndarray) -> np.ndarray:
    """(N,) bool: the `suspect` (N,) corners that no chain of similar neighbours joins to one that is not suspect.

    uv (N, 2) [px] and residual (N, 2) [px] are those of the corners of all images together. Corners with the same
    number `tag` (N,) int, a tag in one image, are no neighbours: they share errors. Neighbours are the nearest in the
    image plane.
    """
    own = np.flatnonzero(suspect)
    if not len(own):
        return np.zeros(len(uv), dtype=bool)
    near = KDTree(uv).query(uv[own], min(N_NEIGHBOURS + CORNERS_PER_TAG, len(uv)))[1].reshape(len(own), -1)
    difference = np.linalg.norm(residual[near] - residual[own, None], axis=2)
    similar = difference < SIMILAR_RATIO * np.linalg.norm(residual[own], axis=1)[:, None]
    similar &= tag[near] != tag[own, None]
    # A graph with a vertex for each suspect corner; vertex 0 stands for all corners that are not suspect.
    keyframe = np.zeros(len(uv), dtype=np.int64)
    keyframe[own] = 1 + np.arange(len(own))
    row, column = np.nonzero(similar)
    ends = keyframe[own][row], keyframe[near[row, column]]
    graph = coo_array((np.ones(len(row)), ends), shape=(len(own) + 1, len(own) + 1))
    component = connected_components(graph, directed=False)[1]
    out = np.zeros(len(uv), dtype=bool)
    out[own[component[1:] != component[0]]] = True
    return out
