"""From a grey image to the corners of a target, and why no target was found."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from icalib.base.extras import load_cv2
from icalib.detection.checkerboard import CheckerboardDetector
from icalib.detection.circles import CirclesDetector
from icalib.detection.decoding import ImageCorners, no_corners
from icalib.detection.growth import PredictedCorners, homography_misfit, predict_corners
from icalib.detection.tag_boards import (
    AprilGridDetector,
    CharucoDetector,
    MarkerDetector,
    all_tags,
    charuco_tags,
    dark_squares,
    grid_tags,
)
from icalib.detection.tags import ImageWithQuads, find_tags, tag_family
from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Circles, Markers, Scene, Target
from icalib.geometry.targets.families import FAMILIES, TagSet, is_available

# Chooses the detector of each target.

_SAME_PX = 3.0  # corners closer together are the same


class Detector(Protocol):
    """Finds one target in images."""

    def detect(self, image: np.ndarray, before: Sequence[ImageCorners] = ()) -> ImageCorners:
        """Corners in the image (h, w) uint8, as indices into the target's points. Faster if the preceding images
        `before` show how the target moves."""
        ...


class _Finder(Protocol):
    """Finds a target by a search of the whole image."""

    def find(self, view: ImageWithQuads) -> ImageCorners:
        """Corners in the whole image, as indices into the target's points."""
        ...


@runtime_checkable
class _Follower(_Finder, Protocol):
    """Finds a target also near predicted corners."""

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        """As `find`, near predicted corners; None if the whole image is to be searched."""
        ...


def detector_of(target: Target) -> Detector:
    """The detector that finds `target`. Raises RigError for a target that cannot be found in images."""
    return _Detector(_finder_of(target))


@dataclass(frozen=True, eq=False)
class _Detector:
    """Uses `finder` near predicted corners, and in the whole image if the target is not found there."""

    finder: _Finder

    def detect(self, image: np.ndarray, before: Sequence[ImageCorners] = ()) -> ImageCorners:
        """As `Detector.detect`."""
        view = ImageWithQuads(image)
        expected = predict_corners(before) if isinstance(self.finder, _Follower) else None
        if expected is not None and isinstance(self.finder, _Follower):
            corners = self.finder.find_near(view, expected)
            if corners is not None:
                return corners
        return self.finder.find(view)


def _finder_of(target: Target) -> _Finder:
    """The finder of a target. Raises RigError if there is none."""
    if isinstance(target, Scene):
        members, tagged = (
            tuple(_finder_of(t) for t in target.targets),
            tuple(t.tags is not None for t in target.targets),
        )
        return _SceneDetector(members, target.first_points[:-1], tagged)
    if isinstance(target, Markers):
        return MarkerDetector(target.family, tuple(target.known.tolist()), target.border_bits)
    if isinstance(target, AprilGrid):
        of = target.rows, target.cols, target.tag_spacing, target.family, target.border_bits
        return AprilGridDetector(*of, target.squares, target.first_id)
    if isinstance(target, Charuco):
        return _Inverted(charuco_detector(target)) if target.inverted else charuco_detector(target)
    if isinstance(target, Checkerboard):
        number = _from_the_bottom(target.rows, target.cols)
        board = _Renumbered(CheckerboardDetector(target.rows, target.cols), number)
        return _Inverted(board) if target.inverted else board
    if isinstance(target, Circles):
        return _Inverted(CirclesDetector(target), either=True)
    raise RigError(f"targets of type {target.type} are not found in images; use corners as a table.")


def charuco_detector(board: Charuco) -> CharucoDetector:
    """The detector of the board, for black on white."""
    ratio = board.marker_size / board.square_size
    return CharucoDetector(board.squares_y, board.squares_x, ratio, board.dictionary, board.legacy)


@dataclass(frozen=True, eq=False)
class _SceneDetector:
    """Finds each target of a scene with its detector in `members`. first (members,): number of its first point in the
    scene.

    A board without tags is dropped if it overlaps with a tagged target, whose squares may look like a small
    checkerboard.
    """

    members: tuple[_Finder, ...]
    first: np.ndarray
    tagged: tuple[bool, ...]  # whether tags identify the member

    def find(self, view: ImageWithQuads) -> ImageCorners:
        detections = list(zip([member.find(view) for member in self.members], self.tagged, strict=True))
        of_tags = np.concatenate([np.zeros((0, 2))] + [corners.uv for corners, tagged in detections if tagged])
        kept = [corners if tagged or _apart(corners.uv, of_tags) else no_corners() for corners, tagged in detections]
        fields = {f.name: np.concatenate([getattr(c, f.name) for c in kept]) for f in dataclasses.fields(ImageCorners)}
        point = np.concatenate([corners.point + first for corners, first in zip(kept, self.first, strict=True)])
        return ImageCorners(**fields | {"point": point})


@dataclass(frozen=True, eq=False)
class _Inverted:
    """Finds with `detector` a board that is white on black; either: in the image as it is, or else white on black."""

    detector: CharucoDetector | CirclesDetector | _Renumbered
    either: bool = False

    def find(self, view: ImageWithQuads) -> ImageCorners:
        corners = self.detector.find(view) if self.either else no_corners()
        return corners if len(corners.point) else self.detector.find(ImageWithQuads(255 - view.image))

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        corners = self.detector.find_near(view, expected) if self.either else None
        return corners or self.detector.find_near(ImageWithQuads(255 - view.image), expected)


@dataclass(frozen=True, eq=False)
class _Renumbered:
    """Converts the numbers of `detector` to those of the target: corner k is point number[k]."""

    detector: CheckerboardDetector
    number: np.ndarray

    def find(self, view: ImageWithQuads) -> ImageCorners:
        corners = self.detector.find(view)
        return corners.renumbered(self.number[corners.point])

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        corners = self.detector.find_near(view, PredictedCorners(np.argsort(self.number)[expected.point], expected.uv))
        return None if corners is None else corners.renumbered(self.number[corners.point])


def _apart(uv: np.ndarray, others: np.ndarray) -> bool:
    """Whether no corner uv (n, 2) px of a board coincides with a corner of the other targets, `others` (m, 2) px."""
    return not len(others) or bool((np.linalg.norm(uv[:, None] - others, axis=2) > _SAME_PX).all())


def _from_the_bottom(rows: int, cols: int) -> np.ndarray:
    """(rows cols,) the target's point of each corner of the detector.

    The target's y points up the sheet, the detector's down. In both orders the square at the first corner is dark. If
    rows is odd and cols even, this holds for the order that reverses each row, else for the one that reverses the rows'
    sequence.
    """
    number = np.arange(rows * cols).reshape(rows, cols)
    return (number[:, ::-1] if rows % 2 == 1 and cols % 2 == 0 else number[::-1]).ravel()


# Explains why no target is found: tries other families, borders and ids, and names the tags that the images show.
#
# Names the board that the images show if its size or layout differs from that in the rig file.

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


def with_other_border(views: Iterable[ImageWithQuads], tags: TagSet, others: Iterable[TagSet]) -> str:
    """A sentence if the first images show the target's `tags` with the other border width, and hardly any
    with the stated one; else "". others: tags that may be in the images, too.

    A tag with the other border width is sometimes decoded, but with wrong corners.
    """
    swapped = TagSet(tags.family, 3 - tags.border_bits, tags.ids)
    ids = sorted(set(tags.ids) - {i for other in others for i in swapped.shared_with(other)})
    ids_by_border: dict[int, list[np.ndarray]] = {1: [], 2: []}
    for view in islice(views, _DIAGNOSED_IMAGES):
        for border, decoded_ids in ids_by_border.items():
            read = view.ids(tags.family, border)
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
        for name, border in product(tried, _BORDERS):
            ids_by_kind.setdefault((name, border, how), []).append(view.ids(name, border))
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


_SEARCHED_IMAGES = 5  # images that are searched; the time is proportional
# images that must show the other board if there are several; in one, cells of a tag may look like a board
_LEAST_IMAGES = 2
_LEAST_SIDE = 3  # inner corners along a side, at least, as the detector demands
_LEAST_TAGS_OF_A_LAYOUT = 6  # tags that an image must show; fewer may fit several layouts
# Misfits in sides of a tag. In the right layout they come from distortion and noise; in a wrong one, tags are a whole
# row or column off.
_MOST_RIGHT = 0.1  # below it, the stated layout is right, and no other is tried
_MOST_BEST = 0.3  # below it, the best layout may be right; large enough for strong distortion
_MOST_RATIO = 0.5  # largest ratio of the best layout's misfit to that of the stated one


def other_size(images: Iterable[np.ndarray], board: Checkerboard) -> str:
    """A sentence on a checkerboard of another size in images (h, w) uint8 that show none of the stated size; "" if
    there is none.

    Candidates are the board whose squares were counted instead of its inner corners, and the largest that OpenCV finds
    in the first five images.
    """
    grey = [255 - i if board.inverted else i for i in islice(images, _SEARCHED_IMAGES)]
    stated = (min(board.rows, board.cols), max(board.rows, board.cols))
    by_squares = (stated[0] - 1, stated[1] - 1)  # the true size if squares were counted
    sizes = ({by_squares} | {size for image in grey for size in _largest_boards(image)}) - {stated}
    counts = {size: _count(grey, size) for size in sorted(sizes) if size[0] >= _LEAST_SIDE}
    if max(counts.values(), default=0) < min(_LEAST_IMAGES, len(grey)):
        return ""
    rows, cols = max(counts, key=lambda size: (counts[size], size == by_squares, size))
    turned = (cols, rows) if board.rows > board.cols else (rows, cols)
    count = counts[rows, cols]
    what = f"a checkerboard of {turned[0]} x {turned[1]} inner corners is in {count} of {len(grey)} of them"
    why = "rows and cols count INNER corners, not squares; " if (rows, cols) == by_squares else ""
    return f"{what}; {why}write rows: {turned[0]}, cols: {turned[1]}."


def checkerboard_in(images: Sequence[np.ndarray]) -> str:
    """Text with the size of the largest checkerboard that at least two of the images (h, w) uint8 show; "" if there is
    none. OpenCV sees small boards in windows, shelves and leaves; those that the detector finds as well count."""
    counts = {size: _count(images, size) for size in {size for image in images for size in _largest_boards(image)}}
    if max(counts.values(), default=0) < _LEAST_IMAGES:
        return ""
    rows, cols = max(counts, key=lambda size: (counts[size], size))
    return f"a checkerboard of {rows} x {cols} inner corners"


def _largest_boards(image: np.ndarray) -> list[tuple[int, int]]:
    """Size of the largest checkerboard that OpenCV finds: inner corners of the shorter and the longer side; [] if there
    is none."""
    cv2 = load_cv2()
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    cv2.setRNGSeed(0)  # the search is random
    success, _, meta = cv2.findChessboardCornersSBWithMeta(image, (_LEAST_SIDE, _LEAST_SIDE), flags)
    return [(min(meta.shape), max(meta.shape))] if success else []


def _count(images: Sequence[np.ndarray], size: tuple[int, int]) -> int:
    """Number of images with a checkerboard of `size` (rows, cols) inner corners."""
    detector = CheckerboardDetector(*size)
    return sum(bool(detector.detect(image).kept.any()) for image in images)


def other_columns(images: Iterable[np.ndarray], board: AprilGrid | Charuco) -> str:
    """A sentence if the tags in the images (h, w) uint8 are arranged with another number of columns than stated; else
    "".

    The first five images are used. A number of columns gives each id a position on the board; the layout with the least
    misfit to a homography is right. The sentence names no number if several layouts fit, as for tags of a single row.
    """
    across, down = ("cols", "rows") if isinstance(board, AprilGrid) else ("squares_x", "squares_y")
    stated, other = getattr(board, across), getattr(board, down)
    tags = _number_of_tags(board)
    detections = _enough(_tags_of(ImageWithQuads(image), board, tags) for image in islice(images, _SEARCHED_IMAGES))
    misfit = {stated: _misfit_of_columns(detections, board, stated, tags)}
    if not detections or misfit[stated] <= _MOST_RIGHT:
        return ""
    for n in range(1, tags + 1):  # more columns than tags give the same single row
        misfit[n] = _misfit_of_columns(detections, board, n, tags)
    least = min(misfit.values())
    if least > _MOST_BEST or misfit[stated] <= least / _MOST_RATIO:
        return ""
    best = [n for n in misfit if misfit[n] < max(_MOST_RIGHT, least / _MOST_RATIO)]
    if len(best) > 1:
        return f"the layout of the tags does not match {across}: {stated}; correct {down} and {across}."
    if best[0] == other:
        return f"{down} and {across} are swapped; write {down}: {stated}, {across}: {other}."
    return f"the layout of the tags matches {across}: {best[0]}, not {stated}; correct {down} and {across}."


def _number_of_tags(board: AprilGrid | Charuco) -> int:
    """Number of tags of the board."""
    if isinstance(board, AprilGrid):
        return board.rows * board.cols
    return int((~dark_squares(board.squares_y, board.squares_x, board.legacy)).sum())


def _with_columns(board: AprilGrid | Charuco, n: int, tags: int) -> list[np.ndarray]:
    """Boards with n tags (AprilGrid) or squares (ChArUco) in a row: (., 4, 2) corners of at least `tags` tags.

    The unit is the side of a tag or of a square. A ChArUco board has two layouts, OpenCV's present and its older one.
    """
    if isinstance(board, AprilGrid):
        return [grid_tags(-(-tags // n), n, board.tag_spacing)]
    rows, ratio = -(-2 * tags // n) + 1, board.marker_size / board.square_size
    dark = dark_squares(rows, n, False)
    return [charuco_tags(dark, ratio), charuco_tags(~dark, ratio)]


def _tags_of(view: ImageWithQuads, board: AprilGrid | Charuco, tags: int) -> tuple[np.ndarray, np.ndarray]:
    """Tags of the board that the image shows exactly once: ids (m,) counted from the first one, below `tags`, and
    corners (m, 4, 2) px."""
    if isinstance(board, AprilGrid):
        detections = find_tags(view, tag_family(board.family), board.border_bits, view.windows[0], board.squares)
        place = detections.ids - board.first_id
    else:
        view = ImageWithQuads(255 - view.image) if board.inverted else view
        detections = all_tags(view, tag_family(board.dictionary), 1)
        place = detections.ids
    _, index, count = np.unique(place, return_index=True, return_counts=True)
    rows = index[count == 1]
    rows = rows[(place[rows] >= 0) & (place[rows] < tags)]
    return place[rows], detections.quads[rows]


def _enough(images: Iterable[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The images, as results of `_tags_of`, that show at least six tags."""
    return [(place, quads) for place, quads in images if len(place) >= _LEAST_TAGS_OF_A_LAYOUT]


def _misfit_of_columns(
    detections: list[tuple[np.ndarray, np.ndarray]], board: AprilGrid | Charuco, n: int, tags: int
) -> float:
    """Misfit of the layout with n columns: median of `homography_misfit` over the images, the smaller one if there are
    two such layouts; inf without images."""
    layouts = _with_columns(board, n, tags) if detections else []
    medians = [np.median([homography_misfit(corners[p], quads) for p, quads in detections]) for corners in layouts]
    return float(min(medians, default=np.inf))
