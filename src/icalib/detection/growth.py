"""Tags and squares of a grid at the positions predicted by those already found."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, hypot
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from icalib.base.compiled import njit
from icalib.detection.decoding import (
    ImageCorners,
    cell_greys,
    levels,
    mapped,
    no_corners,
    popcount,
    read_cells,
    unit_homography,
    visible_cells,
    with_verdicts,
)
from icalib.detection.edge_model import END_PX, LEAST_RISE, USUAL_BLUR_PX, fit_corners, fit_quad, solve_small, step_blur
from icalib.detection.saddles import LEAST_WINDOW_PX, MARGIN_BLURS, crossing_contrast, find_saddle, fit_crossing
from icalib.detection.tags import LEAST_CONTRAST, shortest_side
from icalib.geometry.planes import EDGE

# Kernels that find further tags of a grid at the positions predicted by tags already found.
#
# Kernels that refine the corners of many tags at once, and measure the quality of each corner. Consistency checks:
# whether tags and corners lie where their neighbours predict them.

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


# px, and of a side, the larger of both: largest distance of a corner from its rough position
_MOST_CORNER_MOVE = (2.0, 0.03)
_LEAST_STRIP_PX = 1.5  # least half width of the fitted strip along an edge
_MOST_STRIP = (4.0, 3.0)  # px, and blurs: largest half width of the same strip
_STRIP_BLURS = 2.25  # blurs between the strip along an edge and other features
_BLUR_STRIP = (2.5, 0.06)  # px, and of a side: largest half width of the strip if only the blur is measured
_LEAST_INSET_PX = (1.0, 0.5)  # as LEAST_WINDOW_PX, for features in the dark and in the white fields
_END_BLURS = 2.4  # blurs left out at the ends of a side
MEASURES = 5  # number of rows of `quality` before those of the edges


@njit(cache=True, nogil=True)
def _shape(quad, k):
    """(sine of the angle at corner k, height [px] of the quad over its longer side there, shorter side [px])."""
    ea, eb = side_vectors(quad, k)
    la, lb = hypot(ea[0], ea[1]), hypot(eb[0], eb[1])
    sine = abs(ea[0] * eb[1] - ea[1] * eb[0]) / max(la * lb, 1e-12)
    return sine, min(la, lb) * sine, min(la, lb)


@njit(cache=True, nogil=True)
def _strip(least, blur, most):
    """Half width [px] of the strip along an edge, if the nearest other feature is `least` px away."""
    return min(max(least - _STRIP_BLURS * blur, _LEAST_STRIP_PX), most)


@njit(cache=True, nogil=True)
def _measured_blur(image, quad, k, least):
    """Blur [px] across side k of the quad, or side k + 2 if k has no edge; NaN if neither has one."""
    most = max(_BLUR_STRIP[0], _BLUR_STRIP[1] * shortest_side(quad))
    for m in (k, k + 2):
        u0, v0, u1, v1 = quad[m, 0], quad[m, 1], quad[(m + 1) % 4, 0], quad[(m + 1) % 4, 1]
        blur, contrast = step_blur(image, u0, v0, u1, v1, END_PX, _strip(least, USUAL_BLUR_PX, most))
        if contrast > 0.0:
            return blur
    return np.nan


@njit(cache=True, nogil=True)
def _measured_blurs(image, quads, least):
    """(n, 2) blur [px] across each quad's sides 0 and 1; the median over the image if they have no edge."""
    blur = np.empty((len(quads), 2))
    for i in range(len(quads)):
        for k in range(2):
            blur[i, k] = _measured_blur(image, quads[i], k, least[i])
    known = blur.ravel()[~np.isnan(blur.ravel())]
    usual = np.median(known) if len(known) else USUAL_BLUR_PX
    for i in range(len(quads)):
        for k in range(2):
            if np.isnan(blur[i, k]):
                blur[i, k] = usual
    return blur


@njit(cache=True, nogil=True)
def _shapes(quads, quality):
    """Fills the rows sine, height and side of `quality`; returns (n,) the least height [px] of each quad."""
    least = np.empty(len(quads))
    for i in range(len(quads)):
        for k in range(4):
            quality[2, i, k], quality[3, i, k], quality[4, i, k] = _shape(quads[i], k)
        least[i] = quality[3, i].min()
    return least


@njit(cache=True, nogil=True)
def refined_crossings(image, quads, surroundings):
    """(uv (n, 4, 2) px, quality (5 + 2 EDGE, n, 4)) of the X-corners at the quads (n, 4, 2) px.

    surroundings: as in `fit_crossing`. Rows of quality: sigma [px] per axis for image noise of one grey level, NaN if
    there is no corner; blur [px]; sine of the angle between the edges; distance to the nearest other feature minus the
    distance that the smallest window needs [px]; shorter side [px]; both edges of the corner, as in `edge_fits`.
    """
    uv, quality = np.empty(quads.shape), np.empty((MEASURES + 2 * EDGE, len(quads), 4))
    blur = _measured_blurs(image, quads, surroundings.min() * _shapes(quads, quality))
    for i in range(len(quads)):
        quality[1, i] = blur[i].max()
        for k in range(4):
            ea, eb = side_vectors(quads[i], k)
            most_move = max(_MOST_CORNER_MOVE[0], _MOST_CORNER_MOVE[1] * quality[4, i, k])
            blur_a, blur_b = blur[i, k % 2], blur[i, (k + 1) % 2]
            u, v, sigma, contrast, edges = fit_crossing(
                image, quads[i, k, 0], quads[i, k, 1], ea, eb, surroundings, blur_a, blur_b, most_move
            )
            uv[i, k, 0], uv[i, k, 1] = u, v
            quality[0, i, k] = sigma if contrast >= LEAST_CONTRAST else np.nan
            quality[MEASURES:, i, k] = edges.ravel()
    room = surroundings[0] * quality[3] - LEAST_WINDOW_PX
    for k in range(2):
        room = np.minimum(room, surroundings[1 + k] * quality[3] - _LEAST_INSET_PX[k])
    quality[3] = room - MARGIN_BLURS * quality[1]
    return uv, quality


@njit(cache=True, nogil=True)
def refined_corners(image, quads, clear):
    """As `refined_crossings`, for the L-corners of dark quads with clockwise corners in the image.

    clear: distance of the nearest other feature, in units of the quad's sides.
    """
    uv, quality = np.empty(quads.shape), np.empty((MEASURES + 2 * EDGE, len(quads), 4))
    least = clear * _shapes(quads, quality)
    for i in range(len(quads)):
        most = max(_MOST_STRIP[0], _BLUR_STRIP[1] * shortest_side(quads[i]))
        first, _, blur, _ = fit_corners(image, quads[i], END_PX, _strip(least[i], USUAL_BLUR_PX, most))
        half = _strip(least[i], blur.max(), max(_MOST_STRIP[0], _MOST_STRIP[1] * blur.max()))
        end = max(END_PX, _END_BLURS * blur.max())
        uv[i], quality[0, i], quality[1, i], edges = fit_corners(image, first, end, half)
        for k in range(4):
            quality[MEASURES:, i, k] = edges[k].ravel()
            most_move = max(_MOST_CORNER_MOVE[0], _MOST_CORNER_MOVE[1] * quality[4, i, k])
            if hypot(uv[i, k, 0] - quads[i, k, 0], uv[i, k, 1] - quads[i, k, 1]) > most_move:
                quality[0, i, k] = np.nan
    quality[3] = clear * quality[3] - _LEAST_STRIP_PX - _STRIP_BLURS * quality[1]
    return uv, quality


_PLACING_CORNERS = 12
# px, and of a side, added: largest distance of a corner from its prediction by neighbours
_MOST_CORNER_OFF = (1.0, 0.05)
_OFF = (0.3, 0.01, 6.0)  # px and of a side, added, or times the median distance: the same, if most corners agree better
_STRAIGHT_FOCAL = 1e4  # image widths: focal length of a lens without distortion
_BENT = (0.1, 2.0)  # image widths: range of focal lengths of lenses with distortion
_SAME_LOG = 0.02  # tolerance of the logarithm of the focal length
# share of the median distance without distortion that the model of distortion may leave at single corners
_UNSURE = 0.2
_MOST_ANGLE = 3.0  # rad: largest angle from the axis of a lens
_FAR_PX = 1e9
_LEAST_DEPTH = 0.1  # cosine of the angle between a corner's ray and a neighbour's
_GROWTH_BESIDE = 1.5  # growth of errors with the squared distance from the mean of the neighbours, over their variance
_LINK_OFF = 0.3  # tag sides of error per tag of distance at which a tag still predicts the centre of another


def largest_group(known: np.ndarray, quads: np.ndarray, board: np.ndarray) -> np.ndarray:
    """(n,) bool: the largest group of known tags that are connected by links.

    Two tags are linked if each predicts the other's centre. known (n,) bool; quads (n, 4, 2) px; board (n, 4, 2) in tag
    sizes.
    """
    tags = np.flatnonzero(known)
    links = _links(quads[tags], board[tags])
    groups: list[np.ndarray] = []
    left = np.ones(len(tags), dtype=bool)
    while left.any():
        group = np.zeros(len(tags), dtype=bool)
        group[np.argmax(left)] = True
        while (reached := links[group].any(axis=0) | group).sum() > group.sum():
            group = reached
        groups.append(group)
        left &= ~group
    out = np.zeros(len(known), dtype=bool)
    if groups:
        out[tags[max(groups, key=lambda group: int(group.sum()))]] = True
    return out


@njit(cache=True, nogil=True)
def _links(quads, board):
    """(m, m) bool: which tags predict each other's centre. quads (m, 4, 2) px, board (m, 4, 2) in tag sizes."""
    m = len(quads)
    predicts = np.zeros((m, m), dtype=np.bool_)
    for i in range(m):
        H = unit_homography(quads[i])
        ax, ay = board[i, 1, 0] - board[i, 0, 0], board[i, 1, 1] - board[i, 0, 1]
        bx, by = board[i, 3, 0] - board[i, 0, 0], board[i, 3, 1] - board[i, 0, 1]
        for j in range(m):
            x, y = board[j, :, 0].mean() - board[i, 0, 0], board[j, :, 1].mean() - board[i, 0, 1]
            s, t = x * ax + y * ay, x * bx + y * by
            u, v = mapped(H, s, t)
            side = hypot(quads[j, 1, 0] - quads[j, 0, 0], quads[j, 1, 1] - quads[j, 0, 1])
            side = max(side, hypot(quads[j, 3, 0] - quads[j, 0, 0], quads[j, 3, 1] - quads[j, 0, 1]))
            off = hypot(quads[j, :, 0].mean() - u, quads[j, :, 1].mean() - v)
            predicts[i, j] = off < _LINK_OFF * side * max(hypot(s - 0.5, t - 0.5), 1.0)
    return predicts & predicts.T


def consistent_corners(
    uv: np.ndarray, board: np.ndarray, valid: np.ndarray, side: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """(N,) bool: whether each corner lies where a homography of its 12 nearest neighbours predicts it. True for those
    that are not valid.

    The bound is 6 times the median distance, at least 0.3 px + 0.01 sides and at most 1 px + 0.05 sides. The worst
    corner is left out first, and the others are tested again. If some corners fail, a lens with distortion is tried,
    and used if the median distance is smaller. The bound is then at least a fifth of the median distance without
    distortion.

    uv (N, 2) px, board (N, 2), valid (N,) bool: corners that were measured; side (N,) px; shape (h, w) of the image,
    whose centre is taken for the principal point.
    """
    middle, width = 0.5 * np.array(shape[1::-1]), float(shape[1])
    straight = _agreeing(_rays(uv - middle, _STRAIGHT_FOCAL * width, False), board, valid, side)
    if straight.all():
        return straight
    bent = _bent_rays(uv - middle, width, board, valid)
    usual = [_usual(rays, board, valid) for rays in (_rays(uv - middle, _STRAIGHT_FOCAL * width, False), bent)]
    return _agreeing(bent, board, valid, side, _UNSURE * usual[0]) if usual[1] < usual[0] else straight


Rays = tuple[np.ndarray, np.ndarray]  # (N, 3) unit rays, (N,) px per radian


def _bent_rays(uv: np.ndarray, width: float, board: np.ndarray, valid: np.ndarray) -> Rays:
    """Rays through the lens with distortion at which the corners agree best with their predictions by neighbours. Two
    lens models and any focal length are tried. uv (N, 2) px from the image centre."""
    best: tuple[float, Rays] | None = None
    for equidistant in (False, True):

        def usual(log_focal: float, equidistant: bool = equidistant) -> float:
            return _usual(_rays(uv, width * exp(log_focal), equidistant), board, valid)

        done: Any = minimize_scalar(usual, bounds=np.log(_BENT), method="bounded", options={"xatol": _SAME_LOG})
        if best is None or done.fun < best[0]:
            best = done.fun, _rays(uv, width * exp(done.x), equidistant)
    assert best is not None
    return best[1]


def _usual(rays: Rays, board: np.ndarray, valid: np.ndarray) -> float:
    """Median distance [px] of valid corners from their predictions; 1e9 if there are too few."""
    off = distance_from_neighbours(*rays, board, valid, _PLACING_CORNERS)
    placed = valid & np.isfinite(off)
    return float(np.median(off[placed])) if placed.any() else _FAR_PX


def _agreeing(rays: Rays, board: np.ndarray, valid: np.ndarray, side: np.ndarray, unsure: float = 0.0) -> np.ndarray:
    """As `consistent_corners`, for one lens. unsure [px]: least bound, for the remaining error of the lens model."""
    used, most = valid.copy(), _MOST_CORNER_OFF[0] + _MOST_CORNER_OFF[1] * side
    while True:
        off = distance_from_neighbours(*rays, board, used, _PLACING_CORNERS)
        placed = used & np.isfinite(off)
        usual = float(np.median(off[placed])) if placed.any() else np.inf
        bound = np.minimum(most, np.maximum(_OFF[0] + _OFF[1] * side, max(_OFF[2] * usual, unsure)))
        excess = np.where(placed, off / bound, 0.0)
        if not len(excess) or excess.max() <= 1.0:
            return used | ~valid
        used[np.argmax(excess)] = False


def _rays(uv: np.ndarray, focal: float, equidistant: bool) -> Rays:
    """Rays of pixels uv (N, 2) from the principal point, for focal length `focal` [px]. The lens is stereographic,
    which is the division model of distortion (Fitzgibbon 2001), or equidistant, as most fisheyes nearly are."""
    radius = np.hypot(uv[:, 0], uv[:, 1])
    r = radius / focal
    angle = np.minimum(r, _MOST_ANGLE) if equidistant else 2.0 * np.arctan(0.5 * r)
    across = np.sin(angle) / np.maximum(radius, 1e-12)
    rays = np.column_stack([across[:, None] * uv, np.cos(angle)])
    return rays, np.full(len(uv), focal) if equidistant else focal * (1.0 + 0.25 * r * r)


@njit(cache=True, nogil=True)
def distance_from_neighbours(rays, scale, xy, used, n_near):
    """(n,) px: distance of each corner from its prediction by the nearest corners on the board xy (n, 2); inf if fewer
    than 6 can be used.

    rays (n, 3): of the corners, in the camera; scale (n,): px per radian; used (n,) bool: corners that predict. The
    n_near nearest of them are projected by a pinhole camera that looks at the corner, and a homography predicts it. If
    the corner is beside its neighbours rather than among them, the distance is divided by the growth of errors there.
    """
    out, near = np.full(len(rays), np.inf), np.empty(len(rays))
    px, pu = np.empty((n_near, 2)), np.empty((n_near, 2))
    for i in range(len(rays)):
        for j in range(len(rays)):
            near[j] = hypot(xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]) if used[j] and j != i else np.inf
        order, n = np.argsort(near), 0
        a, b = _across(rays[i])
        for j in order[:n_near]:
            depth = (rays[i] * rays[j]).sum()
            if np.isfinite(near[j]) and depth > _LEAST_DEPTH:
                px[n] = xy[j]
                pu[n, 0], pu[n, 1] = scale[i] * (a * rays[j]).sum() / depth, scale[i] * (b * rays[j]).sum() / depth
                n += 1
        if n >= 6:
            u, v = mapped(fit_homography(px, pu, n), xy[i, 0], xy[i, 1])
            x, y = px[:n, 0].mean(), px[:n, 1].mean()
            spread = ((px[:n, 0] - x) ** 2 + (px[:n, 1] - y) ** 2).mean()
            beside = ((xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2) / max(spread, 1e-12)
            out[i] = hypot(u, v) / (1.0 + _GROWTH_BESIDE * beside)
    return out


@njit(cache=True, nogil=True)
def _across(ray):
    """Two unit vectors (3,) orthogonal to a unit ray and to each other."""
    a = np.array([ray[2], 0.0, -ray[0]]) if abs(ray[1]) > 0.5 else np.array([0.0, ray[2], -ray[1]])
    a /= np.sqrt((a * a).sum())
    b = np.array([ray[1] * a[2] - ray[2] * a[1], ray[2] * a[0] - ray[0] * a[2], ray[0] * a[1] - ray[1] * a[0]])
    return a, b


# Prediction of corners in the next image, and of the missing corners of a board from the known ones.
#
# Corners are extrapolated from image to image: with constant acceleration from three images, with constant velocity
# from two.

_LEAST_COMMON = 4  # corners that the images must share; with fewer the motion of the target is not known
_PREDICTING_CORNERS = 12  # known corners whose homography predicts an unknown one; with more, distortion matters
_MARGIN_PX = 8.0  # corners closer to the border may be missing; doubled, a target that leaves the image is lost later
MOTION_IMAGES = 3  # latest images that the extrapolation uses: the acceleration needs three


class PredictedCorners(NamedTuple):
    """Where corners are expected: point (n,) int64, index into the target's points; uv (n, 2) px."""

    point: np.ndarray
    uv: np.ndarray

    def all_detected(self, image: np.ndarray, corners: ImageCorners, margin_px: float = _MARGIN_PX) -> bool:
        """Whether `corners` has every predicted corner that is more than `margin_px` inside the image (h, w)."""
        high = np.array(image.shape[::-1]) - 1.0 - margin_px
        inside = ((self.uv >= margin_px) & (self.uv <= high)).all(axis=1)
        return bool(np.isin(self.point[inside], corners.point).all())


def predict_corners(before: Sequence[ImageCorners]) -> PredictedCorners | None:
    """The corners of the last image of `before` (oldest first), extrapolated to the next image.

    The step of a corner needs its position in the last three images. A corner that is missing in one of them gets the
    step of the nearest corner that has one. If three images share fewer than four corners, the last two are used. None
    if these share fewer than four as well, or if there are fewer than two images.
    """
    if len(before) < 2:
        return None
    last, recent = before[-1], before[-MOTION_IMAGES:]
    # row_of[i, p]: row of point p in image i, -1 where the image lacks it.
    n_points = 1 + max(int(image.point.max(initial=-1)) for image in recent)
    row_of = np.full((len(recent), n_points), -1, dtype=np.int64)
    for rows, image in zip(row_of, recent, strict=True):
        rows[image.point] = np.arange(len(image.point))
    common = np.flatnonzero((row_of >= 0).all(axis=0))
    if len(common) < _LEAST_COMMON:
        return predict_corners(before[-2:]) if len(recent) > 2 else None
    uv = [image.uv[rows[common]] for rows, image in zip(row_of, recent, strict=True)]
    step = uv[-1] - uv[-2]
    if len(recent) == MOTION_IMAGES:
        step = 2.0 * step - (uv[-2] - uv[-3])
    step_of = np.full(len(last.point), -1)
    step_of[row_of[-1, common]] = np.arange(len(common))
    without = np.flatnonzero(step_of < 0)
    squared_distance = ((last.uv[without, None, :] - uv[-1]) ** 2).sum(axis=2)
    step_of[without] = np.argmin(squared_distance, axis=1)
    return PredictedCorners(last.point, last.uv + step[step_of])


@njit(cache=True, nogil=True)
def predict_nodes(at, uv, rows, cols):
    """(rows, cols, 2) px: positions of all corners of a board, from the known ones.

    at (n, 2) int64: row and column of the known corners; uv (n, 2) px: their positions, which are kept. Each other
    corner is predicted by the homography of the known corners nearest to it on the board.
    """
    out, known = np.empty((rows, cols, 2)), np.zeros((rows, cols), dtype=np.bool_)
    on_board = at.astype(np.float64)
    for i in range(len(at)):
        out[at[i, 0], at[i, 1]], known[at[i, 0], at[i, 1]] = uv[i], True
    n = min(_PREDICTING_CORNERS, len(at))
    for row in range(rows):
        for col in range(cols):
            if known[row, col]:
                continue
            squared_distance = (on_board[:, 0] - row) ** 2 + (on_board[:, 1] - col) ** 2
            near = np.argsort(squared_distance, kind="mergesort")[:n]  # stable, so that ties do not change the result
            out[row, col] = mapped(fit_homography(on_board[near], uv[near], n), float(row), float(col))
    return out


# Boards of black and white squares: detection of their inner corners, in each of which two dark squares touch.

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
