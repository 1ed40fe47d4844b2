"""Do tags and corners lie where the others say?"""

from __future__ import annotations

import numpy as np

from icalib.detection.decoding import mapped, unit_homography
from icalib.detection.growth import distance_from_neighbours

_NEAREST = 12
_MOST_OFF = (1.0, 0.05)  # px, and of a side: how far a corner may lie from where its neighbours place it
_LINK_OFF = 0.3  # of a tag: how far its centre may lie from where another tag predicts it, per tag of distance


def largest_group(known: np.ndarray, quads: np.ndarray, board: np.ndarray) -> np.ndarray:
    """(n,) bool, the largest set of known tags of which each is linked to another of it.

    Two tags are linked where each predicts the other's centre. known (n,) bool; quads (n, 4, 2) px; board (n, 4, 2) in
    tag sizes.
    """
    tags = np.flatnonzero(known)
    links = np.zeros((len(tags), len(tags)), dtype=bool)
    for i, tag in enumerate(tags):
        off = _off(tag, tags, quads, board)
        distance = np.linalg.norm(board[tags].mean(axis=1) - board[tag].mean(axis=0), axis=1)
        links[i] = off < _LINK_OFF * np.maximum(distance, 1.0)
    links &= links.T
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


def _off(tag: int, others: np.ndarray, quads: np.ndarray, board: np.ndarray) -> np.ndarray:
    """(m,) how far, in its own sides, the centre of each other tag lies from where this one predicts it."""
    H = unit_homography(quads[tag])
    origin, a, b = board[tag, 0], board[tag, 1] - board[tag, 0], board[tag, 3] - board[tag, 0]
    off = np.empty(len(others))
    for i, other in enumerate(others):
        local = board[other].mean(axis=0) - origin
        predicted = mapped(H, float(local @ a), float(local @ b))
        side = np.linalg.norm(np.roll(quads[other], 1, axis=0) - quads[other], axis=1).mean()
        off[i] = np.linalg.norm(quads[other].mean(axis=0) - predicted) / side
    return off


def consistent_corners(uv: np.ndarray, board: np.ndarray, found: np.ndarray, side: np.ndarray) -> np.ndarray:
    """(N,) bool: which corners lie within 1 px + 0.05 sides of where the 12 nearest others place them.

    uv (N, 2) px, board (N, 2), found (N,) bool, side (N,) px. The worst is left out first, as long as there is one.
    """
    used = found.copy()
    bound = _MOST_OFF[0] + _MOST_OFF[1] * side
    while True:
        off = distance_from_neighbours(uv, board, used, _NEAREST)
        excess = np.where(used & np.isfinite(off), off / bound, 0.0)
        if not len(excess) or excess.max() <= 1.0:
            return used | ~found
        used[np.argmax(excess)] = False
