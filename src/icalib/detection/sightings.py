"""Summaries of the detections of a target, and removal of tags that are seen too rarely to be real."""

from __future__ import annotations

import dataclasses
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
