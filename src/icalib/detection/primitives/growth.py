"""Kernels that find further tags of a grid at the positions predicted by tags already found."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.detection.primitives.decoding import (
    cell_greys,
    levels,
    mapped,
    popcount,
    read_cells,
    unit_homography,
    visible_cells,
)
from icalib.detection.primitives.edge_model import LEAST_RISE, USUAL_BLUR_PX, solve_small
from icalib.detection.primitives.edges import fit_quad
from icalib.detection.primitives.saddles import crossing_contrast, find_saddle
from icalib.detection.primitives.tags import LEAST_CONTRAST, shortest_side

_NEIGHBOURS = 3  # tags that predict another, none farther than two rows or columns
_LEAST_VISIBLE_CELLS = 12  # visible data cells of a tag that the image border cuts, at least
_WRONG_CELLS = 0.15  # share of visible cells that may be wrong; it is large because the pattern is known
_MOST_PREDICTION_ERROR = 0.12  # of a side: largest distance of a corner from its prediction
LEAST_SIDE_PX = 6.0  # shortest side of a quad that is searched


@njit(cache=True, nogil=True)
def fit_homography(xy, uv, n):
    """(3, 3) H from the first n >= 4 points xy (., 2) to uv (., 2): linear least squares after centring and scaling."""
    mx, my, mu, mv = xy[:n, 0].mean(), xy[:n, 1].mean(), uv[:n, 0].mean(), uv[:n, 1].mean()
    sx = 1.0 / max(np.abs(xy[:n, 0] - mx).max() + np.abs(xy[:n, 1] - my).max(), 1e-12)
    su = 1.0 / max(np.abs(uv[:n, 0] - mu).max() + np.abs(uv[:n, 1] - mv).max(), 1e-12)
    A, b, J = np.zeros((8, 8)), np.zeros(8), np.zeros(8)
    for i in range(n):
        x, y, u, v = sx * (xy[i, 0] - mx), sx * (xy[i, 1] - my), su * (uv[i, 0] - mu), su * (uv[i, 1] - mv)
        for axis in range(2):
            value = u if axis == 0 else v
            J[:] = 0.0
            J[3 * axis], J[3 * axis + 1], J[3 * axis + 2] = x, y, 1.0
            J[6], J[7] = -x * value, -y * value
            for p in range(8):
                b[p] += J[p] * value
                for q in range(p + 1):
                    A[p, q] += J[p] * J[q]
    h = solve_small(A, b)
    H = np.array([[h[0], h[1], h[2]], [h[3], h[4], h[5]], [h[6], h[7], 1.0]])
    to_xy = np.array([[sx, 0.0, -sx * mx], [0.0, sx, -sx * my], [0.0, 0.0, 1.0]])
    from_uv = np.array([[1.0 / su, 0.0, mu], [0.0, 1.0 / su, mv], [0.0, 0.0, 1.0]])
    return _product(from_uv, _product(H, to_xy))


def homography_misfit(corners: np.ndarray, quads: np.ndarray) -> float:
    """Median distance between the quads (m, 4, 2) px and the projected corners (m, 4, 2) of the tags, over the median
    side of a quad.

    The projection is the least-squares homography of all corners. A corner that it maps behind the camera counts as
    infinitely far.
    """
    xy, uv = np.ascontiguousarray(corners.reshape(-1, 2)), np.ascontiguousarray(quads.reshape(-1, 2))
    placed = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ fit_homography(xy, uv, len(xy)).T
    depth = np.where(placed[:, 2:] > 1e-9, placed[:, 2:], np.nan)
    distance = np.linalg.norm(placed[:, :2] / depth - uv, axis=1)
    side = np.median(np.linalg.norm(np.diff(quads, axis=1), axis=2))
    return float(np.median(np.where(np.isnan(distance), np.inf, distance)) / side)


@njit(cache=True, nogil=True)
def _product(A, B):
    """A B of matrices (3, 3)."""
    C = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                C[i, j] += A[i, k] * B[k, j]
    return C


@njit(cache=True, nogil=True)
def predict(tag, known, quads, board, cols):
    """(number of neighbours, quad (4, 2) px): the quad of a tag, predicted by the nearest known tags; 0 without
    neighbours.

    board (n, 4, 2): corners on the board; quads (n, 4, 2) px; known (n,) bool.
    """
    xy, uv, n = np.empty((4 * _NEIGHBOURS, 2)), np.empty((4 * _NEIGHBOURS, 2)), 0
    row, col = tag // cols, tag % cols
    for distance in (1, 2, 4, 5, 8):
        for other in range(len(known)):
            dr, dc = other // cols - row, other % cols - col
            if known[other] and dr * dr + dc * dc == distance and n < 4 * _NEIGHBOURS:
                for k in range(4):
                    xy[n], uv[n] = board[other, k], quads[other, k]
                    n += 1
    quad = np.empty((4, 2))
    if n == 0:
        return 0, quad
    H = fit_homography(xy, uv, n)
    for k in range(4):
        quad[k, 0], quad[k, 1] = mapped(H, board[tag, k, 0], board[tag, k, 1])
    return n // 4, quad


@njit(cache=True, nogil=True)
def side_vectors(quad, k):
    """The two sides (2,) px of the quad that start at its corner k."""
    return quad[(k + 1) % 4] - quad[k], quad[(k + 3) % 4] - quad[k]


@njit(cache=True, nogil=True)
def _fitted(image, quad, clear, crossing):
    """(number of corners found, quad) near a predicted quad. Corners that are not found are shifted by the mean shift
    of the others."""
    side = shortest_side(quad)
    if crossing:
        most, corners, n_corners = _MOST_PREDICTION_ERROR * side + 1.0, quad.copy(), 0
        has_corner, moved = np.zeros(4, dtype=np.bool_), np.zeros(2)
        for k in range(4):
            ea, eb = side_vectors(quad, k)
            has_saddle, u, v = find_saddle(image, quad[k, 0], quad[k, 1], ea, eb, clear, USUAL_BLUR_PX, most)
            if has_saddle and crossing_contrast(image, u, v, ea, eb, clear, USUAL_BLUR_PX) >= LEAST_CONTRAST:
                corners[k, 0], corners[k, 1], has_corner[k] = u, v, True
                moved += corners[k] - quad[k]
                n_corners += 1
        for k in range(4):
            if n_corners > 0 and not has_corner[k]:
                corners[k] += moved / n_corners
        return n_corners, corners
    fits, corners = fit_quad(image, quad, min(max(1.5, 0.1 * side), 6.0), LEAST_RISE)
    return 4 if fits else 0, corners


@njit(cache=True, nogil=True)
def _is_tag(image, quad, pattern, bits, border):
    """Whether the visible cells inside the quad agree with the pattern (uint64)."""
    n = bits + 2 * border
    grey = cell_greys(image, unit_homography(quad), n)
    black, white = levels(grey, border)
    if white - black < LEAST_CONTRAST:
        return False
    code, wrong = read_cells(grey, border, 0.5 * (black + white))
    visible = visible_cells(grey, border)
    n_visible = popcount(visible)
    wrong += popcount((code ^ pattern) & visible)
    return n_visible >= _LEAST_VISIBLE_CELLS and wrong <= _WRONG_CELLS * n_visible


@njit(cache=True, nogil=True)
def confirm(image, known, quads, patterns, bits, border, clear, crossing):
    """(n,) bool: which of the `known` tags the image shows near their quads (n, 4, 2) px, which are accurate to some
    pixels.

    Quads of confirmed tags are moved to the measured corners. The other arguments are those of `grow`.
    """
    confirmed = np.zeros(len(known), dtype=np.bool_)
    for tag in range(len(known)):
        if known[tag] and shortest_side(quads[tag]) >= LEAST_SIDE_PX:
            n_corners, quad = _fitted(image, quads[tag], clear, crossing)
            if n_corners >= 2 and _is_tag(image, quad, patterns[tag], bits, border):
                quads[tag], confirmed[tag] = quad, True
    return confirmed


@njit(cache=True, nogil=True)
def decoded_markers(image, quads, patterns, bits, border):
    """(n,) bool: whether the image shows pattern i (n,) uint64 inside quad i (n, 4, 2) px."""
    decoded = np.zeros(len(quads), dtype=np.bool_)
    for i in range(len(quads)):
        decoded[i] = _is_tag(image, quads[i], patterns[i], bits, border)
    return decoded


@njit(cache=True, nogil=True)
def grow(image, known, quads, board, cols, patterns, bits, border, clear, crossing):
    """Adds to known (n,) bool and quads (n, 4, 2) px the tags that are found at their predictions by neighbours.

    patterns (n,) uint64: of the board's tags. bits, border: data cells along a side, and width of the black border in
    cells. clear: distance of the nearest other feature, in sides. With `crossing` the tags' corners touch other dark
    squares; then two corners suffice, so that a tag cut by the image border is found.
    """
    tried = np.zeros(len(known), dtype=np.int64)  # number of neighbours at the last attempt
    changed = True
    while changed:
        changed = False
        for tag in range(len(known)):
            if known[tag]:
                continue
            neighbours, quad = predict(tag, known, quads, board, cols)
            if neighbours <= tried[tag]:
                continue
            tried[tag] = neighbours
            if not np.abs(quad).max() < 1e5 or shortest_side(quad) < LEAST_SIDE_PX:
                continue
            n_corners, quad = _fitted(image, quad, clear, crossing)
            if n_corners >= 2 and _is_tag(image, quad, patterns[tag], bits, border):
                known[tag], quads[tag], changed = True, quad, True
