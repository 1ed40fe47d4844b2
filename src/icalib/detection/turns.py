"""Targets that look alike after half a turn: which way up each image shows them, from the images before it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from icalib.detection.corners import ImageCorners
from icalib.detection.sightings import parts_of
from icalib.geometry.targets import Target


def continuous(target: Target, images: Sequence[ImageCorners]) -> list[ImageCorners]:
    """The images (in the order in which one camera took them) with the points of symmetric targets renumbered, so that
    from each image to the next they move least. The first keeps its numbers: any choice is as good as another one."""
    images = list(images)
    for _, part, first in parts_of(target):
        if part.symmetric:
            before = np.full((len(part.points), 2), np.nan)
            for k, image in enumerate(images):
                own = (image.point >= first) & (image.point < first + len(part.points))
                if own.any():
                    turn = _nearest(part.turns, before, image.point[own] - first, image.uv[own])
                    images[k] = _renumbered(image, own, first, turn)
                    before = np.full_like(before, np.nan)
                    before[turn[image.point[own] - first]] = image.uv[own]
    return images


def _nearest(turns: Sequence[np.ndarray], before: np.ndarray, point: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """The turn (n,) after which points at uv (m, 2) px are nearest to where they were, `before` (n, 2), NaN unseen."""
    moved = [np.linalg.norm(before[turn[point]] - uv, axis=1) for turn in turns]
    mean = [float(np.nanmean(m)) if np.isfinite(m).any() else np.inf for m in moved]
    return turns[int(np.argmin(mean))]


def _renumbered(image: ImageCorners, own: np.ndarray, first: int, turn: np.ndarray) -> ImageCorners:
    point = image.point.copy()
    point[own] = first + turn[point[own] - first]
    order = np.argsort(point)
    fields = {f.name: getattr(image, f.name)[order] for f in dataclasses.fields(image)}
    return ImageCorners(**fields | {"point": point[order]})
