"""Corners that are rejected: those that stand out of their image, and apart from all that is seen near them.

A lens that its model cannot follow makes large errors near the border of the image, but similar ones in neighbouring
corners of all images, smaller ones further in. A gross outlier stands alone. So a corner that stands out of its image
is kept where a chain of neighbours in the image plane, each with an error like the one before, leads to a corner that
does not stand out.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from icalib.estimation.corner_factor import CornerFactor, CornerOutput
from icalib.estimation.medians import grouped_quantiles, largest_normal
from icalib.rig import Settings

NEIGHBOURS = 12  # with twice as many, small outliers near the border find one that is alike by chance
FOUND_TOGETHER = 4  # consecutive points of one image, which a detector finds (and misses) together: a tag's corners
ALIKE = 0.7  # of a residual: how far its neighbour's may be from it


def inliers(factor: CornerFactor, out: CornerOutput, settings: Settings) -> np.ndarray:
    """(N,) bool: corners that are not rejected; those that the model cannot see go too.

    A corner stands out when its residual is larger than `outlier_min_px` and than the mean of normal errors plus
    `outlier_std` standard deviations, by the median of its image or of all, whichever is larger.
    """
    if settings.outlier_std <= 0.0:
        return np.ones(len(out.root), dtype=bool)
    used = np.flatnonzero((out.root > 0.0) | ~factor.keep)  # what was rejected may fit better now
    residual, stream = out.residual[used].astype(np.float64), factor.stream
    size, image = np.linalg.norm(residual, axis=1), stream.image[used]
    median = grouped_quantiles(size, image, len(stream.stamps_ns), 0.5)[image]
    usual = np.maximum(median, np.median(size)) if len(size) else median
    limit = np.maximum(largest_normal(settings.outlier_std, 0.5) * usual, settings.outlier_min_px)
    found_in = image * (1 + stream.point.max(initial=0) // FOUND_TOGETHER) + stream.point[used] // FOUND_TOGETHER
    kept = np.zeros(len(out.root), dtype=bool)
    # Without a robust loss nothing bounds what a kept corner pulls.
    suspect = size > limit
    alone = suspect if settings.loss == "none" else stand_alone(stream.uv[used], residual, suspect, found_in)
    kept[used[~alone]] = True
    return kept


def stand_alone(uv: np.ndarray, residual: np.ndarray, suspect: np.ndarray, found_in: np.ndarray) -> np.ndarray:
    """(N,) bool: which `suspect` (N,) corners no chain of neighbours joins to one that is not suspect.

    Corners at uv (N, 2) [px] with residuals (N, 2) [px]. Those with the same number `found_in` (N,) say nothing for
    one another.
    """
    own = np.flatnonzero(suspect)
    if not len(own):
        return np.zeros(len(uv), dtype=bool)
    near = KDTree(uv).query(uv[own], min(NEIGHBOURS + FOUND_TOGETHER, len(uv)))[1].reshape(len(own), -1)
    off = np.linalg.norm(residual[near] - residual[own, None], axis=2)
    alike = (off < ALIKE * np.linalg.norm(residual[own], axis=1)[:, None]) & (found_in[near] != found_in[own, None])
    # Node 0 stands for all corners that are not suspect.
    node = np.zeros(len(uv), dtype=np.int64)
    node[own] = 1 + np.arange(len(own))
    row, column = np.nonzero(alike)
    ends = node[own][row], node[near[row, column]]
    graph = coo_array((np.ones(len(row)), ends), shape=(len(own) + 1, len(own) + 1))
    part = connected_components(graph, directed=False)[1]
    alone = np.zeros(len(uv), dtype=bool)
    alone[own[part[1:] != part[0]]] = True
    return alone
