"""Prediction of corners in the next image, and of the missing corners of a board from the known ones.

Corners are extrapolated from image to image: with constant acceleration from three images, with constant velocity from
two.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.detection.primitives.corners import ImageCorners
from icalib.detection.primitives.decoding import mapped
from icalib.detection.primitives.growth import fit_homography

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
