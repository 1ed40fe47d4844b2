"""Names the size of the board in the images where the rig file has another, and says what to write."""

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

_SEARCHED_IMAGES = 5  # that are searched; the time grows with it
_LEAST_IMAGES = 2  # that show a board of another size, of several; the cells of a tag may look like a board in one
_LEAST_SIDE = 3  # inner corners along a side; the detector takes no smaller board
_LEAST_TAGS_OF_A_LAYOUT = 6  # in an image; fewer may fit several layouts
# Misfits, in sides of a tag. In a right layout they come from lens and noise; in a wrong one tags are a whole row or
# column off.
_MOST_RIGHT = 0.1  # at most: the stated layout is right, and no other is looked at
_MOST_BEST = 0.3  # at most: the best layout may be the right one; a lens that bends the board much needs room
_MOST_RATIO = 0.5  # of the best layout's misfit to the stated one's


def other_size(images: Iterable[np.ndarray], board: Checkerboard) -> str:
    """A sentence on the checkerboard in images (h, w) uint8 in which none of the stated size was found.

    "" where the first five images show none of another size either. Candidates are the board whose squares were counted
    in place of its inner corners, and the largest that OpenCV finds.
    """
    grey = [255 - i if board.inverted else i for i in islice(images, _SEARCHED_IMAGES)]
    stated = (min(board.rows, board.cols), max(board.rows, board.cols))
    by_squares = (stated[0] - 1, stated[1] - 1)  # the true size where squares were counted
    sizes = ({by_squares} | {size for image in grey for size in _largest(image)}) - {stated}
    seen = {size: _count(grey, size) for size in sorted(sizes) if size[0] >= _LEAST_SIDE}
    if max(seen.values(), default=0) < min(_LEAST_IMAGES, len(grey)):
        return ""
    rows, cols = max(seen, key=lambda size: (seen[size], size == by_squares, size))
    turned = (cols, rows) if board.rows > board.cols else (rows, cols)
    what = f"a checkerboard of {turned[0]} x {turned[1]} inner corners is in {seen[rows, cols]} of {len(grey)} of them"
    why = "rows and cols count INNER corners, not squares; " if (rows, cols) == by_squares else ""
    return f"{what}; {why}write rows: {turned[0]}, cols: {turned[1]}."


def checkerboard_in(images: Sequence[np.ndarray]) -> str:
    """The largest checkerboard that at least two of the images (h, w) uint8 show, in words; "" for none."""
    sizes = [size for image in images for size in _largest(image)]
    seen = {size: sizes.count(size) for size in set(sizes)}
    if max(seen.values(), default=0) < _LEAST_IMAGES:
        return ""
    rows, cols = max(seen, key=lambda size: (seen[size], size))
    return f"a checkerboard of {rows} x {cols} inner corners"


def _largest(image: np.ndarray) -> list[tuple[int, int]]:
    """Inner corners of the sides, the shorter first, of the largest checkerboard that OpenCV finds; [] if none."""
    cv2 = load_cv2()
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    cv2.setRNGSeed(0)  # the search draws at random
    found, _, meta = cv2.findChessboardCornersSBWithMeta(image, (_LEAST_SIDE, _LEAST_SIDE), flags)
    return [(min(meta.shape), max(meta.shape))] if found else []


def _count(images: list[np.ndarray], size: tuple[int, int]) -> int:
    """In how many images a checkerboard of `size` (rows, cols) inner corners is found."""
    detector = CheckerboardDetector(*size)
    return sum(bool(detector.detect(image).kept.any()) for image in images)


def other_columns(images: Iterable[np.ndarray], board: AprilGrid | Charuco) -> str:
    """A sentence where the tags in the images (h, w) uint8 stand as on a board with another number of columns.

    "" where the first five images show the stated layout, or too few tags to tell. Each number of columns gives every
    id a place on the board; the layout with the least misfit to a homography wins. Several win where the tags that are
    seen do not tell them apart, as those of a single row; then the sentence names none.
    """
    across, down = ("cols", "rows") if isinstance(board, AprilGrid) else ("squares_x", "squares_y")
    stated, other = getattr(board, across), getattr(board, down)
    tags = _number_of_tags(board)
    seen = _enough(_tags_of(ImageWithQuads(image), board, tags) for image in islice(images, _SEARCHED_IMAGES))
    misfit = {stated: _misfit_of_columns(seen, board, stated, tags)}
    if not seen or misfit[stated] <= _MOST_RIGHT:
        return ""
    for n in range(1, tags + 1):  # with more columns, all tags are in the first row
        misfit[n] = _misfit_of_columns(seen, board, n, tags)
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
    if isinstance(board, AprilGrid):
        return board.rows * board.cols
    return int((~dark_squares(board.squares_y, board.squares_x, board.legacy)).sum())


def _with_columns(board: AprilGrid | Charuco, n: int, tags: int) -> list[np.ndarray]:
    """The boards that have n tags (AprilGrid) or squares (ChArUco) in a row: (., 4, 2) corners of at least `tags` tags.

    The unit is the tag's side or the square's. A ChArUco board has two layouts, OpenCV's today and its older one.
    """
    if isinstance(board, AprilGrid):
        return [grid_tags(-(-tags // n), n, board.tag_spacing)]
    rows, ratio = -(-2 * tags // n) + 1, board.marker_size / board.square_size
    dark = dark_squares(rows, n, False)
    return [charuco_tags(dark, ratio), charuco_tags(~dark, ratio)]


def _tags_of(view: ImageWithQuads, board: AprilGrid | Charuco, tags: int) -> tuple[np.ndarray, np.ndarray]:
    """Ids (m,), from the board's first on, of its `tags` tags that the image shows once; corners (m, 4, 2) px."""
    if isinstance(board, AprilGrid):
        found = find_tags(view, tag_family(board.family), board.border_bits, view.windows[0], board.squares)
        place = found.ids - board.first_id
    else:
        view = ImageWithQuads(255 - view.image) if board.inverted else view
        found = all_tags(view, tag_family(board.dictionary), 1)
        place = found.ids
    _, index, count = np.unique(place, return_index=True, return_counts=True)
    rows = index[count == 1]
    rows = rows[(place[rows] >= 0) & (place[rows] < tags)]
    return place[rows], found.quads[rows]


def _enough(images: Iterable[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Those of the images, each as `_tags_of` gives it, that show six tags."""
    return [(place, quads) for place, quads in images if len(place) >= _LEAST_TAGS_OF_A_LAYOUT]


def _misfit_of_columns(
    seen: list[tuple[np.ndarray, np.ndarray]], board: AprilGrid | Charuco, n: int, tags: int
) -> float:
    """The least median over images of `homography_misfit`, of the layouts with n columns; inf without images."""
    layouts = _with_columns(board, n, tags) if seen else []
    medians = [np.median([homography_misfit(corners[place], quads) for place, quads in seen]) for corners in layouts]
    return float(min(medians, default=np.inf))
