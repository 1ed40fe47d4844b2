"""Do tags and corners lie where the others say?"""

from __future__ import annotations

from math import hypot

import numpy as np
from numba import njit

from icalib.detection.decoding import mapped, unit_homography
from icalib.detection.growth import distance_from_neighbours

_NEAREST = 12
_MOST_OFF = (1.0, 0.05)  # px, and of a side: how far a corner may lie from where its neighbours place it
_OFF = (0.3, 0.01, 6.0)  # px, of a side, and times the median: the same, as far as the other corners agree
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


def consistent_corners(uv: np.ndarray, board: np.ndarray, found: np.ndarray, side: np.ndarray) -> np.ndarray:
    """(N,) bool: which corners lie where the 12 nearest others place them.

    The bound is 6 times the median distance, at least 0.3 px + 0.01 sides and at most 1 px + 0.05 sides. The worst
    corner is left out first, as long as there is one. uv (N, 2) px, board (N, 2), found (N,) bool, side (N,) px.
    """
    used = found.copy()
    most = _MOST_OFF[0] + _MOST_OFF[1] * side
    while True:
        off = distance_from_neighbours(uv, board, used, _NEAREST)
        placed = used & np.isfinite(off)
        usual = float(np.median(off[placed])) if placed.any() else np.inf
        bound = np.minimum(most, np.maximum(_OFF[0] + _OFF[1] * side, _OFF[2] * usual))
        excess = np.where(placed, off / bound, 0.0)
        if not len(excess) or excess.max() <= 1.0:
            return used | ~found
        used[np.argmax(excess)] = False
