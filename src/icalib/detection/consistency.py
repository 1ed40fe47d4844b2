"""Do tags and corners lie where the others say?"""

from __future__ import annotations

from math import hypot

import numpy as np
from numba import njit

from icalib.detection.decoding import mapped, unit_homography
from icalib.detection.growth import fit_homography

_NEAREST = 12
_MOST_OFF = (1.0, 0.05)  # px, and of a side: how far a corner may lie from where its neighbours place it
_OFF = (0.3, 0.01, 6.0)  # px, of a side, and times the median: the same, as far as the other corners agree
_STRAIGHT = 1e4  # image widths, the focal length of a lens that does not bend
_BENT = (0.8, 0.57, 0.4, 0.28, 0.2, 0.14)  # the same of lenses that do; those between are near enough to one of them
_LEAST_DEPTH = 0.1  # cosine of the angle between a corner's ray and a neighbour's
_GROWTH_BESIDE = 1.5  # of errors with the square of the distance from the neighbours, in units of their spread
_LINK_OFF = 0.3  # of a tag: how far its centre may lie from where another tag predicts it, per tag of distance


def largest_group(known: np.ndarray, quads: np.ndarray, board: np.ndarray) -> np.ndarray:
    """(n,) bool, the largest set of known tags of which each is linked to another of it.

    Two tags are linked where each predicts the other's centre. known (n,) bool; quads (n, 4, 2) px; board (n, 4, 2) in
    tag sizes.
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
    seen_from = np.zeros((m, m), dtype=np.bool_)
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
            seen_from[i, j] = off < _LINK_OFF * side * max(hypot(s - 0.5, t - 0.5), 1.0)
    return seen_from & seen_from.T


def consistent_corners(
    uv: np.ndarray, board: np.ndarray, found: np.ndarray, side: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """(N,) bool: which corners lie where the 12 nearest others place them, by a homography.

    The bound is 6 times the median distance, at least 0.3 px + 0.01 sides and at most 1 px + 0.05 sides. The worst
    corner is left out first, as long as there is one. Where a straight lens places some elsewhere, so do lenses that
    bend, and the one counts whose median distance is least. uv (N, 2) px, board (N, 2), found (N,) bool, side (N,) px;
    shape (h, w) of the image, whose middle is taken for the lens's.
    """
    straight = _agreeing(uv, board, found, side, shape, _STRAIGHT)
    if straight.all():
        return straight
    usual = [_usual(uv, board, found, shape, focal) for focal in (_STRAIGHT, *_BENT)]
    best = (_STRAIGHT, *_BENT)[int(np.argmin(usual))]
    return straight if best == _STRAIGHT else _agreeing(uv, board, found, side, shape, best)


def _usual(uv: np.ndarray, board: np.ndarray, found: np.ndarray, shape: tuple[int, ...], focal: float) -> float:
    """The median distance of the corners found; inf where there are too few."""
    off = distance_from_neighbours(*_on_sphere(uv, shape, focal), board, found, _NEAREST)
    placed = found & np.isfinite(off)
    return float(np.median(off[placed])) if placed.any() else np.inf


def _agreeing(
    uv: np.ndarray, board: np.ndarray, found: np.ndarray, side: np.ndarray, shape: tuple[int, ...], focal: float
) -> np.ndarray:
    """As `consistent_corners`, for one lens."""
    used, rays = found.copy(), _on_sphere(uv, shape, focal)
    most = _MOST_OFF[0] + _MOST_OFF[1] * side
    while True:
        off = distance_from_neighbours(*rays, board, used, _NEAREST)
        placed = used & np.isfinite(off)
        usual = float(np.median(off[placed])) if placed.any() else np.inf
        bound = np.minimum(most, np.maximum(_OFF[0] + _OFF[1] * side, _OFF[2] * usual))
        excess = np.where(placed, off / bound, 0.0)
        if not len(excess) or excess.max() <= 1.0:
            return used | ~found
        used[np.argmax(excess)] = False


def _on_sphere(uv: np.ndarray, shape: tuple[int, ...], focal: float) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) unit rays of a stereographic lens with a focal length of `focal` image widths, and (N,) px per radian.

    It is the division model of distortion (Fitzgibbon 2001), right to some pixels for every fisheye, and keeps angles,
    so that the scale is the same in all directions.
    """
    f = focal * shape[1]
    x, y = ((uv - 0.5 * np.array(shape[1::-1])) / (2.0 * f)).T
    stretch = 1.0 + x * x + y * y
    return np.stack([2.0 * x, 2.0 * y, 2.0 - stretch], axis=1) / stretch[:, None], f * stretch


@njit(cache=True, nogil=True)
def distance_from_neighbours(rays, scale, xy, used, n_near):
    """(n,) px from each corner to where the nearest others on the board xy (n, 2) place it.

    rays (n, 3) are the corners' in the camera, scale (n,) px per radian. Others are the n_near nearest that are `used`
    (n,) bool; inf where there are fewer than 6. They are seen by a pinhole camera that looks at the corner. The
    distance of a corner that lies beside its neighbours, not among them, is divided by how much errors grow on the way.
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
    """Two unit vectors (3,) at right angles to a unit ray and to each other."""
    a = np.array([ray[2], 0.0, -ray[0]]) if abs(ray[1]) > 0.5 else np.array([0.0, ray[2], -ray[1]])
    a /= np.sqrt((a * a).sum())
    b = np.array([ray[1] * a[2] - ray[2] * a[1], ray[2] * a[0] - ray[0] * a[2], ray[0] * a[1] - ray[1] * a[0]])
    return a, b
