"""Explains why no target is found: tries other families, borders and ids, and names the tags that the images show."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product
from typing import Literal

import numpy as np

from icalib.detection.boards.detectors import charuco_detector
from icalib.detection.primitives.families import tag_family
from icalib.detection.primitives.quads import ImageWithQuads
from icalib.detection.primitives.tags import tags_at
from icalib.geometry.targets import Charuco
from icalib.geometry.targets.families import FAMILIES, TagSet, is_available

_DIAGNOSED_IMAGES = 5  # images that are searched; the time is proportional
_SIZES = (50, 100, 250, 1000)  # numbers of tags of OpenCV's families; each contains the smaller ones
_TRIED = ("tag36h11", "tag25h9", "tag16h5", "tag36h10", "aruco_original", "aruco_mip_36h12") + tuple(
    f"{n}x{n}_{size}" for n, size in ((4, 250), (5, 1000), (6, 1000), (7, 1000))
)
_BORDERS = (1, 2)
_LEAST_TAGS = {4: 4}  # by data cells along a side; fewer tags may be false detections
_LEAST_TAGS_USUALLY = 2
_MANY_MORE = 4  # ratio of tags with the other border to those with the stated one, above which the border is wrong
_CLEARLY_BETTER = 0.5  # ratio of misfits below which the other layout is right


_How = Literal["", "mirrored", "inverted"]
_HOWS: tuple[_How, ...] = ("", "mirrored", "inverted")


@dataclass(frozen=True)
class _VisibleTags:
    """Tags of one family that the images show, if the images are first mirrored or inverted as `how` says."""

    family: str
    border_bits: int
    how: _How
    ids: np.ndarray  # all decoded ids, with repetitions


def what_is_seen(
    images: Iterable[np.ndarray], family: str, border_bits: int, ids: Sequence[int], field: str = "family"
) -> str:
    """A sentence on the tags in the first images (h, w) uint8 of a recording in which no target was found.

    family, border_bits, ids: of the target; field: name of the family's field in the rig file. Raises RecordingError
    for an image that is not grey.
    """
    candidates = _candidates([ImageWithQuads(image).image for image in islice(images, _DIAGNOSED_IMAGES)])
    stated_family = _largest(family)
    candidates.sort(key=lambda tags: (len(tags.ids), tags.family == stated_family), reverse=True)
    if not candidates:
        return (
            "the images show no tags of any known family; check that the target is in view, sharp, well lit, "
            "and that a tag is larger than about 20 pixels."
        )
    return _sentence(candidates[0], family, border_bits, ids, field)


def tags_in(images: Sequence[np.ndarray]) -> str:
    """Text on the tags of any known family that the images (h, w) uint8 show; "" if there are none."""
    tags = max(_candidates([ImageWithQuads(i).image for i in images]), key=lambda one: len(one.ids), default=None)
    return "" if tags is None else _words(tags)


def with_other_border(images: Iterable[np.ndarray], tags: TagSet, others: Iterable[TagSet]) -> str:
    """A sentence if the first images (h, w) uint8 show the target's `tags` with the other border width, and hardly any
    with the stated one; else "". others: tags that may be in the images, too.

    A tag with the other border width is sometimes decoded, but with wrong corners.
    """
    swapped = TagSet(tags.family, 3 - tags.border_bits, tags.ids)
    ids = sorted(set(tags.ids) - {i for other in others for i in swapped.shared_with(other)})
    ids_by_border: dict[int, list[np.ndarray]] = {1: [], 2: []}
    for image in islice(images, _DIAGNOSED_IMAGES):
        view = ImageWithQuads(image)
        quads = np.concatenate([view.quads(window, apart) for window in view.windows for apart in (True, False)])
        for border, decoded_ids in ids_by_border.items():
            read = tags_at(view.image, quads, tag_family(tags.family), border).ids
            decoded_ids.append(read[np.isin(read, ids)])
    stated, swap = (np.concatenate([np.zeros(0, np.int64), *ids_by_border[t.border_bits]]) for t in (tags, swapped))
    if len(swap) < _MANY_MORE * max(len(stated), 1):
        return ""
    return _sentence(_VisibleTags(tags.family, swapped.border_bits, "", swap), tags.family, tags.border_bits, tags.ids)


def with_other_layout(images: Iterable[np.ndarray], board: Charuco) -> str:
    """A sentence if the markers in the first images (h, w) uint8 are arranged as on a board of the other layout; else
    "". In the wrong layout, markers of every other row are off by one square to the left or right, and no homography
    fits all markers."""
    if board.squares_y % 2:
        return ""  # both layouts are equal
    detectors = [charuco_detector(b) for b in (board, replace(board, legacy=not board.legacy))]
    views = [ImageWithQuads(255 - image if board.inverted else image) for image in islice(images, _DIAGNOSED_IMAGES)]
    misfits = np.array([[d.misfit(view) for d in detectors] for view in views]).reshape(-1, 2)
    misfits = misfits[np.isfinite(misfits).all(axis=1)]
    if not len(misfits) or np.median(misfits[:, 1]) > _CLEARLY_BETTER * np.median(misfits[:, 0]):
        return ""
    if board.legacy:
        return "the board has the layout of OpenCV 4.6 and later, its top left square is black; remove legacy: true."
    return (
        "the board has the layout of OpenCV before 4.6 and of calib.io, its top left square is white; set "
        "legacy: true of the target."
    )


def _candidates(images: list[np.ndarray]) -> list[_VisibleTags]:
    """The tags of each family and border that are found in larger numbers than by chance."""
    ids_by_kind: dict[tuple[str, int, _How], list[np.ndarray]] = {}
    tried = [name for name in _TRIED if is_available(name)]
    for image, how in product(images, _HOWS):
        view = ImageWithQuads({"": image, "mirrored": image[:, ::-1], "inverted": 255 - image}[how])
        quads = np.concatenate([view.quads(window, apart) for window in view.windows for apart in (True, False)])
        for name, border in product(tried, _BORDERS):
            ids = tags_at(view.image, quads, tag_family(name), border).ids
            ids_by_kind.setdefault((name, border, how), []).append(ids)
    tags = [_VisibleTags(*key, np.concatenate(ids)) for key, ids in ids_by_kind.items()]
    least = {name: _LEAST_TAGS.get(tag_family(name).bits, _LEAST_TAGS_USUALLY) for name in tried}
    return [one for one in tags if len(one.ids) >= least[one.family]]


def _sentence(tags: _VisibleTags, family: str, border_bits: int, ids: Sequence[int], field: str = "family") -> str:
    """A sentence on the visible tags, and the field of the rig file to correct."""
    what = _words(tags)
    if tags.how == "inverted":
        return f"the images show {what}, white on black; set inverted: true of a ChArUco board."
    if tags.how:
        return f"the images are mirrored, they show {what} after flipping; switch off mirroring in the camera's driver."
    if tags.family != _largest(family):
        return (
            f"the images show {what}, none of {family}; correct the target's {field}: write {field}: {_smallest(tags)}."
        )
    if tags.border_bits != border_bits:
        return f"the images show {what} with border_bits {tags.border_bits}, not {border_bits}; correct border_bits."
    if not np.isin(tags.ids, ids).any():
        return (
            f"the images show {what}, none of those of the target; set first_id: {tags.ids.min()} of an aprilgrid, or "
            "correct the target's ids, rows and cols."
        )
    return f"the images show {what}; check that rows, cols and spacing are those of the target."


def _words(tags: _VisibleTags) -> str:
    """Text with the number, family and ids of the tags."""
    return f"{len(tags.ids)} tags of {_smallest(tags)} (ids {tags.ids.min()} to {tags.ids.max()})"


def _largest(family: str) -> str:
    """The family in _TRIED that contains all patterns of `family`."""
    return next((name for name in _TRIED if name.split("_")[0] == family.split("_")[0] and "x" in family), family)


def _smallest(tags: _VisibleTags) -> str:
    """The smallest of OpenCV's families that has the ids of all these tags."""
    start = tags.family.split("_")[0]
    fitting = (f"{start}_{size}" for size in _SIZES if size > tags.ids.max() and f"{start}_{size}" in FAMILIES)
    return next(fitting, tags.family) if "x" in start else tags.family
