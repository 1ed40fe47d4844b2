"""X-corners that belong to no known board: whether an image shows a grid of them, and whether a board goes on."""

from __future__ import annotations

from math import hypot

import numpy as np
from numba import njit
from scipy.sparse.csgraph import connected_components

from icalib.detection.saddles import crossing_contrast, find_saddle
from icalib.detection.tags import LEAST_CONTRAST
from icalib.extras import load_cv2

# Of ChESS (Bennett and Lasenby, Computer Vision and Image Understanding 118, 2014): 16 places at 5 px from a pixel.
_RING = ((0, -5), (2, -5), (3, -3), (5, -2), (5, 0), (5, 2), (3, 3), (2, 5))
_RING_PX = 5
_SCALES = 3  # the image itself, and twice at half the size of the one before
_LEAST_RESPONSE = 4 * LEAST_CONTRAST  # of ChESS: four sums of two greys, of which noise and blur take a part
_APART_PX = 7  # between two corners
_MOST_PEAKS = 500  # of an image, the strongest
_NEAREST = 8  # places among which a corner's neighbours are looked for
_OPPOSITE = 0.25  # of the distance: how far the middle of two opposite neighbours may be from the corner, twice
_LEAST_SINE = 0.3  # of the angle between rows and columns
_MOST_MOVE = 0.2  # of a side: how far a corner may lie from where the rows of a board lead
_CLEAR = 0.5  # squares, to the nearest other feature
_USUAL_BLUR = 0.7  # px
_GOES_ON = 0.5  # of the places along one side of a board that are X-corners


def in_rows(image: np.ndarray, enough: float) -> bool:
    """Whether the image (h, w) uint8 shows `enough` X-corners that stand in rows and columns, at any of three sizes."""
    cv2 = load_cv2()
    for _ in range(_SCALES):
        response = _response(image)
        peak = (response == cv2.dilate(response, np.ones((_APART_PX, _APART_PX)))) & (response > _LEAST_RESPONSE)
        at = np.argwhere(peak)
        strongest = np.argsort(-response[peak], kind="stable")[:_MOST_PEAKS]
        if _largest_grid(at[strongest].astype(np.float64)) >= enough:
            return True
        if min(image.shape) < 8 * _RING_PX:
            break
        image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return False


def _largest_grid(at: np.ndarray) -> int:
    """Most of the points at (n, 2) px that hang together by links, each between two that have neighbours opposite to
    each other in two directions."""
    if len(at) <= _NEAREST:
        return 0
    links = _links(at)
    inner = links.any(axis=1)
    links = links[np.ix_(inner, inner)]
    _, group = connected_components(links | links.T, directed=False)
    return int(np.bincount(group, minlength=1).max())


@njit(cache=True, nogil=True)
def _links(at):
    """(n, n) bool: from each point with two pairs of opposite neighbours, not in one line, to these."""
    n = len(at)
    links, far = np.zeros((n, n), dtype=np.bool_), np.empty(n)
    for i in range(n):
        for j in range(n):
            far[j] = hypot(at[j, 0] - at[i, 0], at[j, 1] - at[i, 1])
        near = np.argsort(far)[1 : _NEAREST + 1]
        first = -1
        for a in range(_NEAREST):
            for b in range(a + 1, _NEAREST):
                p, q = at[near[a]] - at[i], at[near[b]] - at[i]
                if hypot(p[0] + q[0], p[1] + q[1]) > _OPPOSITE * min(far[near[a]], far[near[b]]):
                    continue
                links[i, near[a]] = links[i, near[b]] = True
                if first < 0:
                    first = near[a]
        other = False
        for j in near:
            if links[i, j]:
                p, q = at[j] - at[i], at[first] - at[i]
                other |= abs(p[0] * q[1] - p[1] * q[0]) > _LEAST_SINE * far[j] * far[first]
        if not other:
            links[i] = False
    return links


def _response(image: np.ndarray) -> np.ndarray:
    """(h - 10, w - 10) float32, ChESS: opposite places alike, those a quarter turn away different, the mean as in the
    middle."""
    grey = load_cv2().GaussianBlur(image, (0, 0), 1.0).astype(np.int16)
    h, w = grey.shape

    def moved(dx: int, dy: int) -> np.ndarray:
        return grey[_RING_PX + dy : h - _RING_PX + dy, _RING_PX + dx : w - _RING_PX + dx]

    pairs = [(moved(dx, dy), moved(-dx, -dy)) for dx, dy in _RING]
    sums = [a + b for a, b in pairs]
    crossed = sum(np.abs(sums[k] - sums[k + 4]).astype(np.int32) for k in range(4))
    unlike = sum(np.abs(a - b).astype(np.int32) for a, b in pairs)
    middle = sum(moved(dx, dy).astype(np.int32) for dx, dy in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)))
    off = np.abs(sum(s.astype(np.int32) for s in sums) - 16 * middle // 5)
    return (crossed - unlike - off).astype(np.float32)


def goes_on(image: np.ndarray, framed: np.ndarray) -> bool:
    """Whether a board goes on beyond one of its sides: half of the places beside it are X-corners, too.

    framed (rows + 2, cols + 2, 2) px: the inner corners with one more row and column on each side.
    """
    for turned in (framed, framed[::-1], framed.swapaxes(0, 1), framed.swapaxes(0, 1)[::-1]):
        beside, inner = turned[0], turned[1, 1:-1]
        along = 0.5 * (beside[2:] - beside[:-2])
        if _crossings(image, beside[1:-1].copy(), along, inner - beside[1:-1]) > _GOES_ON * len(inner):
            return True
    return False


@njit(cache=True, nogil=True)
def _crossings(image, at, ea, eb):
    """How many X-corners there are near the places at (n, 2) px, from which edges lead along ea and eb (n, 2) px."""
    count = 0
    for i in range(len(at)):
        most = _MOST_MOVE * min(hypot(ea[i, 0], ea[i, 1]), hypot(eb[i, 0], eb[i, 1])) + 1.0
        found, u, v = find_saddle(image, at[i, 0], at[i, 1], ea[i], eb[i], _CLEAR, _USUAL_BLUR, most)
        if found:
            contrast = crossing_contrast(image, u, v, ea[i], eb[i], _CLEAR, _USUAL_BLUR)
            if max(contrast, crossing_contrast(image, u, v, -ea[i], eb[i], _CLEAR, _USUAL_BLUR)) >= LEAST_CONTRAST:
                count += 1
    return count
