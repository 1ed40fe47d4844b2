"""Names the board that the images show if its size or layout differs from that in the rig file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import islice

import numpy as np

from icalib.base.extras import load_cv2
from icalib.detection.boards.aprilgrid import grid_tags
from icalib.detection.boards.charuco import charuco_tags, dark_squares
from icalib.detection.boards.checkerboard import CheckerboardDetector
from icalib.detection.boards.markers import all_tags
from icalib.detection.primitives.families import tag_family
from icalib.detection.primitives.growth import homography_misfit
from icalib.detection.primitives.quads import ImageWithQuads
from icalib.detection.primitives.tags import find_tags
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard

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
    sizes = ({by_squares} | {size for image in grey for size in _largest(image)}) - {stated}
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
    none."""
    sizes = [size for image in images for size in _largest(image)]
    counts = {size: sizes.count(size) for size in set(sizes)}
    if max(counts.values(), default=0) < _LEAST_IMAGES:
        return ""
    rows, cols = max(counts, key=lambda size: (counts[size], size))
    return f"a checkerboard of {rows} x {cols} inner corners"


def _largest(image: np.ndarray) -> list[tuple[int, int]]:
    """Size of the largest checkerboard that OpenCV finds: inner corners of the shorter and the longer side; [] if there
    is none."""
    cv2 = load_cv2()
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    cv2.setRNGSeed(0)  # the search is random
    success, _, meta = cv2.findChessboardCornersSBWithMeta(image, (_LEAST_SIDE, _LEAST_SIDE), flags)
    return [(min(meta.shape), max(meta.shape))] if success else []


def _count(images: list[np.ndarray], size: tuple[int, int]) -> int:
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
