"""Summaries of the detections of a target, and removal of tags that are seen too rarely to be real.

Numbers the points of rotationally symmetric targets consistently over all images of a camera.

One image does not show which of several rotations of the target it sees. The preceding image does, if the target moved
little in between.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from math import ceil

import numpy as np

from icalib.detection.primitives.corners import KEPT, VERDICTS, ImageCorners
from icalib.geometry.targets import Markers, Scene, Target

LEAST_IMAGES = 3  # least number of images with a tag whose id is not listed; fewer may be false detections
LEAST_IMAGE_SHARE = 0.01  # the same, as a share of all images
_MOST_IDS = 10  # ids in a sentence, at most
Part = tuple[str, Target, int]  # name, target, number of its first point


def parts_of(target: Target) -> list[Part]:
    """The targets of a scene, or the target itself without a name."""
    if not isinstance(target, Scene):
        return [("", target, 0)]
    return list(zip(target.names, target.targets, target.first_points[:-1].tolist(), strict=True))


def n_images_with(images: list[ImageCorners], part: Part) -> int:
    """Number of images with kept corners of the part."""
    _, target, first = part
    return sum(bool((i.kept & (i.point >= first) & (i.point < first + len(target.points))).any()) for i in images)


def without_rare_tags(target: Target, images: list[ImageCorners]) -> tuple[list[ImageCorners], tuple[str, ...]]:
    """The images without free tags that fewer than LEAST_IMAGES or LEAST_IMAGE_SHARE of them show, and sentences that
    name these tags.

    Small families have false detections, and a false tag would get a pose in the map. Tags whose ids are listed are
    kept.
    """
    least = max(LEAST_IMAGES, ceil(LEAST_IMAGE_SHARE * len(images)))
    notes: list[str] = []
    for name, part, first in parts_of(target):
        if not isinstance(part, Markers) or part.ids:
            continue
        count = np.zeros(len(part.known), dtype=np.int64)
        for i in images:
            tags = (i.point[i.kept] - first) // 4
            count[np.unique(tags[(tags >= 0) & (tags < len(count))])] += 1
        rare = np.flatnonzero((count > 0) & (count < least))
        if not len(rare):
            continue
        images = [_without(i, first, rare) for i in images]
        ids = ", ".join(str(k) for k in part.known[rare[:_MOST_IDS]]) + (", ..." if len(rare) > _MOST_IDS else "")
        notes.append(
            f"{len(rare)} tags of {part.family} (ids {ids}) are in fewer than {least} of {len(images)} images "
            f"and were ignored; list the ids{' of ' + name if name else ''} in the rig file if they exist."
        )
    return images, tuple(notes)


def _without(image: ImageCorners, first: int, tags: np.ndarray) -> ImageCorners:
    """The image without the tags with these indices into `Markers.known`, whose points begin at `first`."""
    rows = ~np.isin((image.point - first) // 4, tags)
    return ImageCorners(*(getattr(image, f.name)[rows] for f in dataclasses.fields(image)))


def sightings(target: Target, images: list[ImageCorners]) -> tuple[str, ...]:
    """Sentences: how many images show each target, how many corners were dropped and why, and which targets are never
    seen."""
    kept = sum(int(i.kept.sum()) for i in images)
    dropped = {name: sum(i.counts()[name] for i in images) for k, name in enumerate(VERDICTS) if k != KEPT}
    reasons = ", ".join(f"{n} {name}" for name, n in dropped.items() if n)
    tail = f"; corners rejected: {reasons}" if reasons else ""
    counts = {part[0] or "the target": n_images_with(images, part) for part in parts_of(target)}
    words = ", ".join(f"{name} is in {n}" for name, n in counts.items())
    missing = " and ".join(name for name, n in counts.items() if not n)
    notes = (f"{words} of {len(images)} images, {kept} corners{tail}.",)
    return (*notes, f"{missing} is never seen; check its type, family, ids and sizes.") if missing else notes


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
