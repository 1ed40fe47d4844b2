"""Where the corners of one image are to be expected in the next, and kernels that expect the rest of a board there.

Corners move on with the acceleration [px / image^2] that they had in the last three images, or with the speed that they
had in the last two.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from icalib.detection.corners import ImageCorners
from icalib.detection.decoding import mapped
from icalib.detection.growth import fit_homography

_LEAST_COMMON = 4  # corners that two images must share to show how the target moves
_NEAREST = 12  # corners that place a node of a board that was not seen before
_MARGIN_PX = 8.0  # a corner further inside the image than that must be found again
IMAGES = 3  # that show how corners move


class Expected(NamedTuple):
    """Corners that are to be seen: point (n,) int64, uv (n, 2) px."""

    point: np.ndarray
    uv: np.ndarray

    def are_found(self, image: np.ndarray, found: ImageCorners, margin_px: float = _MARGIN_PX) -> bool:
        """Whether all that lie further inside the image (h, w) than the margin were found."""
        high = np.array(image.shape[::-1]) - 1.0 - margin_px
        inside = ((self.uv >= margin_px) & (self.uv <= high)).all(axis=1)
        return bool(np.isin(self.point[inside], found.point).all())


def expected_next(before: Sequence[ImageCorners]) -> Expected | None:
    """The corners of the last of the images `before`, in order, where they should be in the next one; None where two
    images do not show how they move. A corner that not all images have moves as the nearest one that they have."""
    if len(before) < 2:
        return None
    last, recent = before[-1], before[-IMAGES:]
    at = np.full((len(recent), 1 + max(int(image.point.max(initial=-1)) for image in recent)), -1, dtype=np.int64)
    for row, image in zip(at, recent, strict=True):
        row[image.point] = np.arange(len(image.point))
    common = np.flatnonzero((at >= 0).all(axis=0))
    if len(common) < _LEAST_COMMON:
        return expected_next(before[-2:]) if len(recent) > 2 else None
    places = [image.uv[row[common]] for row, image in zip(at, recent, strict=True)]
    step = places[-1] - places[-2]
    if len(recent) == IMAGES:
        step = 2.0 * step - (places[-2] - places[-3])
    like = np.full(len(last.point), -1)
    like[at[-1, common]] = np.arange(len(common))
    fresh = np.flatnonzero(like < 0)
    apart = ((last.uv[fresh, None, :] - places[-1]) ** 2).sum(axis=2)
    like[fresh] = np.argmin(apart, axis=1)
    return Expected(last.point, last.uv + step[like])


@njit(cache=True, nogil=True)
def expected_nodes(at, uv, rows, cols):
    """(rows, cols, 2) px: the nodes of a board, from those that are expected at (n, 2) int64 (row, column) at uv (n, 2)
    px. The others lie where the homography of the nearest ones puts them."""
    out, known = np.empty((rows, cols, 2)), np.zeros((rows, cols), dtype=np.bool_)
    xy = at.astype(np.float64)
    for i in range(len(at)):
        out[at[i, 0], at[i, 1]], known[at[i, 0], at[i, 1]] = uv[i], True
    n = min(_NEAREST, len(at))
    for row in range(rows):
        for col in range(cols):
            if known[row, col]:
                continue
            apart = (xy[:, 0] - row) ** 2 + (xy[:, 1] - col) ** 2
            near = np.argsort(apart, kind="mergesort")[:n]
            out[row, col] = mapped(fit_homography(xy[near], uv[near], n), float(row), float(col))
    return out
