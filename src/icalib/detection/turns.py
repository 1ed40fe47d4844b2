"""Numbers the points of rotationally symmetric targets consistently over all images of a camera.

One image does not show which of several rotations of the target it sees. The preceding image does, if the target moved
little in between.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.detection.primitives.corners import ImageCorners
from icalib.detection.sightings import parts_of
from icalib.geometry.targets import Target


def number_continuously(target: Target, images: Sequence[ImageCorners]) -> list[ImageCorners]:
    """The images, with the points of each symmetric target renumbered.

    `images` are those of one camera in temporal order. In each image, the rotation is chosen that moves the points
    least from the last image with a known position of the whole target. The first image keeps its numbers, because no
    rotation is preferred there.
    """
    images = list(images)
    for _, part, first in parts_of(target):
        if part.symmetric:
            previous_uv = None
            for k, image in enumerate(images):
                rows = (image.point >= first) & (image.point < first + len(part.points))
                if rows.any():
                    turn = _nearest_turn(part.turns, previous_uv, image.point[rows] - first, image.uv[rows])
                    point = image.point.copy()
                    point[rows] = first + turn[point[rows] - first]
                    images[k] = image.renumbered(point)
                    completed = _completed(part.points[:, :2], point[rows] - first, image.uv[rows])
                    previous_uv = previous_uv if completed is None else completed
    return images


def _nearest_turn(
    turns: Sequence[np.ndarray], previous_uv: np.ndarray | None, point: np.ndarray, uv: np.ndarray
) -> np.ndarray:
    """The renumbering (n,) by a rotation for which points (m,) at uv (m, 2) px are nearest to their former positions,
    on average.

    previous_uv (n, 2) px: former positions of all points of the target, so that rotations are compared by the same
    points. The first of `turns` if it is None.
    """
    if previous_uv is None:
        return turns[0]
    return min(turns, key=lambda turn: float(np.linalg.norm(previous_uv[turn[point]] - uv, axis=1).mean()))


def _completed(board: np.ndarray, point: np.ndarray, uv: np.ndarray) -> np.ndarray | None:
    """(n, 2) px: the points (m,) at uv (m, 2), and the predicted positions of the other points of the board (n, 2).

    Predictions come from the least-squares affine map. Its error under perspective is a small fraction of the board's
    size; with a wrong rotation, points are off by half of it. None if the points are on one line.
    """
    plane = np.concatenate([board - board.mean(axis=0), np.full((len(board), 1), np.ptp(board))], axis=1)
    affine, _, rank, _ = np.linalg.lstsq(plane[point], uv, rcond=1e-6)
    if rank < 3:
        return None
    completed = plane @ affine
    completed[point] = uv
    return completed
