"""Numbers the points of rotationally symmetric targets alike in all images of a camera.

One image does not show which of several turns of the sheet it sees. The image before it does, if the target moved
little in between.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from icalib.detection.corners import ImageCorners
from icalib.detection.sightings import parts_of
from icalib.geometry.targets import Target


def number_continuously(target: Target, images: Sequence[ImageCorners]) -> list[ImageCorners]:
    """The images, with the points of each symmetric target renumbered.

    `images` are those of one camera in temporal order. In each the turn is chosen that moves the points least from the
    last image that shows the target. The first image keeps its numbers: no turn of it is more right than another.
    """
    images = list(images)
    for _, part, first in parts_of(target):
        if part.symmetric:
            previous_uv = np.full((len(part.points), 2), np.nan)
            for k, image in enumerate(images):
                own = (image.point >= first) & (image.point < first + len(part.points))
                if own.any():
                    turn = _nearest_turn(part.turns, previous_uv, image.point[own] - first, image.uv[own])
                    images[k] = _renumbered(image, own, first, turn)
                    previous_uv = np.full_like(previous_uv, np.nan)
                    previous_uv[turn[image.point[own] - first]] = image.uv[own]
    return images


def _nearest_turn(
    turns: Sequence[np.ndarray], previous_uv: np.ndarray, point: np.ndarray, uv: np.ndarray
) -> np.ndarray:
    """The turn (n,) that moves points (m,) at uv (m, 2) px least, by the mean distance from where they were.

    previous_uv (n, 2) px, NaN of points that were not seen. The first turn where no point was seen before.
    """
    distances = [np.linalg.norm(previous_uv[turn[point]] - uv, axis=1) for turn in turns]
    mean = [float(np.nanmean(d)) if np.isfinite(d).any() else np.inf for d in distances]
    return turns[int(np.argmin(mean))]


def _renumbered(image: ImageCorners, own: np.ndarray, first: int, turn: np.ndarray) -> ImageCorners:
    """The image with the points `own` (N,) bool of the part from `first` on turned; all are sorted by number again."""
    point = image.point.copy()
    point[own] = first + turn[point[own] - first]
    order = np.argsort(point)
    fields = {f.name: getattr(image, f.name)[order] for f in dataclasses.fields(image)}
    return ImageCorners(**fields | {"point": point[order]})
