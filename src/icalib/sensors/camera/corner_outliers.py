"""Rejects corners with large residuals, unless their neighbours in the image plane have similar ones.

Misfit of the lens model causes large residuals near the border of the image. They are similar for neighbouring corners
of all images, and decrease towards the middle. A gross outlier has no similar neighbours. So a corner with a large
residual is only suspect. It is kept if a chain of neighbours with similar residuals leads from it to a corner that is
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

N_NEIGHBOURS = 12  # nearest corners; with 24, small outliers near the border have similar neighbours by chance
# Corners without suspicion, among which neighbours are searched: one per 4 x 4 px of an image of 752 x 480 px. With
# fewer, neighbours are farther away; with more, the search needs more time and memory.
MAX_UNSUSPECT_CORNERS = 20_000
CORNERS_PER_TAG = 4  # corners of a tag in one image are no neighbours: a misidentified tag displaces all alike
SIMILAR_RATIO = 0.7  # largest difference of similar residuals over the suspect's; at 1, zero would be similar


def inliers(factor: CornerFactor, out: CornerOutput, settings: Settings) -> np.ndarray:
    """(N,) bool: corners that are not rejected. Corners outside the range of the lens model are rejected, too.

    A corner is suspect if its residual is longer than `outlier_min_px`, and longer than mean plus `outlier_std`
    standard deviations of normal errors. Lengths of normal errors have a Rayleigh distribution. Its scale follows from
    the median length of the image or of all images, whichever is larger. A suspect corner is rejected if it is
    `isolated`, or if the loss is `none`. All corners are kept if `outlier_std` is 0.
    """
    if settings.outlier_std <= 0.0:
        return np.ones(len(out.root), dtype=bool)
    used = np.flatnonzero((out.root > 0.0) | ~factor.keep)  # rejected corners are tested again: they may fit now
    kept = np.zeros(len(out.root), dtype=bool)
    kept[used] = ~rejected(factor, used, out.residual[used], settings)
    return kept


def rejected(factor: CornerFactor, rows: np.ndarray, residual: np.ndarray, settings: Settings) -> np.ndarray:
    """(n,) bool: outliers among the corners `rows` (n,) of the stream, with residuals (n, 2) [px]; see `inliers`."""
    if settings.outlier_std <= 0.0:
        return np.zeros(len(rows), dtype=bool)
    # Double precision: in gaps of the IMU, poses may project points to 1e20 px, and squares would overflow.
    residual = residual.astype(np.float64)
    stream, size = factor.stream, np.linalg.norm(residual, axis=1)
    image = stream.image[rows]
    usual = grouped_quantiles(size, image, len(stream.stamps_ns), 0.5)
    if len(size):
        usual = np.maximum(usual, np.median(size))
    limit = np.maximum(largest_normal(settings.outlier_std, 0.5) * usual, settings.outlier_min_px)
    suspect = size > limit[image]
    if settings.loss == "none" or not suspect.any():  # without robust loss, an outlier has unbounded influence
        return suspect
    some, number = _with_neighbours(suspect), factor.bodies.target.tag_number
    tag = image[some] * (1 + number.max(initial=0)) + number[stream.point[rows[some]]]
    suspect[some] = isolated(stream.uv[rows[some]], residual[some], suspect[some], tag)
    return suspect


def _with_neighbours(suspect: np.ndarray) -> np.ndarray:
    """(n,) sorted indices of all corners that are `suspect` (N,) bool, and of every k-th other corner, at most
    MAX_UNSUSPECT_CORNERS."""
    others = np.flatnonzero(~suspect)
    return np.union1d(np.flatnonzero(suspect), others[:: 1 + len(others) // MAX_UNSUSPECT_CORNERS])


def isolated(uv: np.ndarray, residual: np.ndarray, suspect: np.ndarray, tag: np.ndarray) -> np.ndarray:
    """(N,) bool: `suspect` (N,) corners without a chain of similar neighbours to a corner that is not suspect.

    uv, residual (N, 2) [px]: corners of all images together. tag (N,) int: a number for each tag in each image; corners
    with the same number share errors, and are no neighbours. Neighbours are the nearest corners in the image plane.
    """
    suspects = np.flatnonzero(suspect)
    if not len(suspects):
        return np.zeros(len(uv), dtype=bool)
    near = KDTree(uv).query(uv[suspects], min(N_NEIGHBOURS + CORNERS_PER_TAG, len(uv)))[1].reshape(len(suspects), -1)
    difference = np.linalg.norm(residual[near] - residual[suspects, None], axis=2)
    similar = difference < SIMILAR_RATIO * np.linalg.norm(residual[suspects], axis=1)[:, None]
    similar &= tag[near] != tag[suspects, None]
    # A graph with a vertex for each suspect corner; vertex 0 stands for all corners that are not suspect.
    vertex = np.zeros(len(uv), dtype=np.int64)
    vertex[suspects] = 1 + np.arange(len(suspects))
    row, column = np.nonzero(similar)
    ends = vertex[suspects][row], vertex[near[row, column]]
    graph = coo_array((np.ones(len(row)), ends), shape=(len(suspects) + 1, len(suspects) + 1))
    component = connected_components(graph, directed=False)[1]
    out = np.zeros(len(uv), dtype=bool)
    out[suspects[component[1:] != component[0]]] = True
    return out
