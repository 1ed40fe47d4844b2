"""Consistency checks: whether tags and corners lie where their neighbours predict them."""

from __future__ import annotations

from math import exp, hypot
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from icalib.base.compiled import njit
from icalib.detection.primitives.decoding import mapped, unit_homography
from icalib.detection.primitives.growth import fit_homography

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
