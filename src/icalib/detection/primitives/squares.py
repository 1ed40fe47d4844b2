"""Boards of black and white squares: detection of their inner corners, in each of which two dark squares touch."""

from __future__ import annotations

from math import hypot

import numpy as np

from icalib.base.compiled import njit
from icalib.detection.primitives.corners import ImageCorners, no_corners, with_verdicts
from icalib.detection.primitives.edge_model import USUAL_BLUR_PX
from icalib.detection.primitives.growth import LEAST_SIDE_PX, consistent_corners, refined_crossings, side_vectors
from icalib.detection.primitives.prediction import predict_nodes
from icalib.detection.primitives.saddles import crossing_contrast, find_saddle
from icalib.detection.primitives.tags import LEAST_CONTRAST, shortest_side

_MOST_SQUARE_MOVE = 0.15  # of a side: largest distance of a corner from its expected position
_CLEAR = 0.5  # squares: half the distance to the next corner, at which its window begins
_LEAST_CORNERS = 24  # corners of dark squares (most corners have two) from which the whole board can be predicted again
# distance of the nearest other feature, below which a second search would use windows of the least size, too
_LEAST_CLEAR_PX = 3.0


def square_corners(image: np.ndarray, expected: np.ndarray, dark: np.ndarray, inset: float) -> ImageCorners:
    """Inner corners of a board of `rows` x `cols` squares, numbered row by row, refined and with verdicts.

    image (h, w) uint8. expected (rows + 1, cols + 1, 2) px: all corners of the squares, accurate to about 0.15 squares;
    columns and rows turn clockwise in the image. dark (rows, cols) bool. inset: distance of markers from the edges of
    the white squares [squares], inf without markers.
    """
    rows, cols = dark.shape
    uv, sigma, quality = np.zeros((rows + 1, cols + 1, 2)), np.full((rows + 1, cols + 1), np.nan), {}
    row, col = np.nonzero(dark)
    at = np.stack([[row, col], [row, col + 1], [row + 1, col + 1], [row + 1, col]], axis=0).transpose(2, 0, 1)
    inner = ((at >= 1) & (at < [rows, cols])).all(axis=2)
    clear = min(inset, _CLEAR)
    quads, valid = _moved_to_saddles(image, expected[at[:, :, 0], at[:, :, 1]], inner, clear)
    if valid.sum() >= _LEAST_CORNERS and clear * _usual_side(quads) >= _LEAST_CLEAR_PX:
        # Search again from the corners found, so that the result does not depend on `expected`.
        expected = predict_nodes(at[valid], quads[valid], rows + 1, cols + 1)
        quads, valid = _moved_to_saddles(image, expected[at[:, :, 0], at[:, :, 1]], inner, clear)
    usable = np.array([shortest_side(quad) >= LEAST_SIDE_PX for quad in quads], dtype=bool)
    at, quads, valid = at[usable], quads[usable], valid[usable]
    fine, measures = refined_crossings(image, quads, np.array([_CLEAR, np.inf, inset]))
    for i, k in zip(*np.nonzero(valid & np.isfinite(measures[0])), strict=True):
        where = tuple(at[i, k])
        if not measures[0, i, k] >= sigma[where]:
            uv[where], sigma[where], quality[where] = fine[i, k], measures[0, i, k], measures[:, i, k]
    return _with_verdicts(uv, quality, cols, image.shape)


def _usual_side(quads: np.ndarray) -> float:
    """Median side [px] of the quads (n, 4, 2)."""
    return float(np.median(np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2)))


def _with_verdicts(uv: np.ndarray, quality: dict, cols: int, shape: tuple[int, ...]) -> ImageCorners:
    """Corners with verdicts. quality: measures of `refined_crossings` by (row, col) of the corner; shape: of the
    image."""
    if not quality:
        return no_corners()
    where = np.array(sorted(quality), dtype=np.int64).reshape(-1, 2)
    measures = np.array([quality[tuple(w)] for w in where]).reshape(len(where), -1).T
    corners = uv[where[:, 0], where[:, 1]]
    board = where[:, ::-1].astype(np.float64)
    consistent = consistent_corners(corners, board, np.ones(len(where), dtype=bool), measures[4], shape)
    point = (where[:, 0] - 1) * (cols - 1) + where[:, 1] - 1
    return with_verdicts(point, corners, measures, consistent)


@njit(cache=True, nogil=True)
def _moved_to_saddles(image, quads, inner, clear):
    """(quads (n, 4, 2), valid (n, 4)): dark squares, with those corners that are `inner` moved to saddles, and whether
    each was found."""
    out, valid = quads.copy(), np.zeros(inner.shape, dtype=np.bool_)
    for i in range(len(quads)):
        for k in range(4):
            if not inner[i, k] or shortest_side(quads[i]) < LEAST_SIDE_PX:
                continue
            ea, eb = side_vectors(quads[i], k)
            most = _MOST_SQUARE_MOVE * min(hypot(ea[0], ea[1]), hypot(eb[0], eb[1])) + 1.0
            u, v = quads[i, k]
            has_saddle, u, v = find_saddle(image, u, v, ea, eb, clear, USUAL_BLUR_PX, most)
            if has_saddle and crossing_contrast(image, u, v, ea, eb, clear, USUAL_BLUR_PX) >= LEAST_CONTRAST:
                out[i, k, 0], out[i, k, 1], valid[i, k] = u, v, True
    return out, valid
