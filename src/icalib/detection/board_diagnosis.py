"""Names the size of the board in the images where the rig file has another, and says what to write."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

import numpy as np

from icalib.detection.aprilgrid import grid_tags
from icalib.detection.charuco import charuco_tags, dark_squares
from icalib.detection.checkerboard import CheckerboardDetector
from icalib.detection.decoding import mapped
from icalib.detection.families import tag_family
from icalib.detection.growth import fit_homography
from icalib.detection.markers import all_tags
from icalib.detection.quads import View
from icalib.detection.tags import find_tags
from icalib.extras import load_cv2
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard

_MOST_IMAGES = 5  # that are searched; the time grows with it
_LEAST_SIDE = 3  # inner corners along a side; the detector takes no smaller board
_MOST_COLUMNS = 20  # tags or squares in a row of the layouts that are tried
_LEAST_TAGS = 6  # in an image; fewer may fit several layouts
# Misfits of `_misfit`, in sides of a tag. In a right layout it comes from lens and noise; in a wrong one
# tags are a whole row or column off.
_MOST_RIGHT = 0.1  # at most: the stated layout is right, and no other is looked at
_MOST_BEST = 0.3  # at most: the best layout may be the right one; a lens that bends the board much needs room
_MOST_RATIO = 0.5  # of the best layout's misfit to the stated one's


def other_size(images: Iterable[np.ndarray], board: Checkerboard) -> str:
    """A sentence on the checkerboard in images (h, w) uint8 in which none of the stated size was found.

    "" where the first five images show none of another size either. Candidates are the board whose squares were counted
    in place of its inner corners, and the largest that OpenCV finds.
    """
    grey = [255 - i if board.inverted else i for i in islice(images, _MOST_IMAGES)]
    stated = (min(board.rows, board.cols), max(board.rows, board.cols))
    by_squares = (stated[0] - 1, stated[1] - 1)  # the true size where squares were counted
    sizes = ({by_squares} | {size for image in grey for size in _largest(image)}) - {stated}
    seen = {size: _count(grey, size) for size in sorted(sizes) if size[0] >= _LEAST_SIDE}
    if not any(seen.values()):
        return ""
    rows, cols = max(seen, key=lambda size: (seen[size], size == by_squares, size))
    turned = (cols, rows) if board.rows > board.cols else (rows, cols)
    what = f"a checkerboard of {turned[0]} x {turned[1]} inner corners is in {seen[rows, cols]} of {len(grey)} of them"
    why = "rows and cols count INNER corners, not squares; " if (rows, cols) == by_squares else ""
    return f"{what}; {why}write rows: {turned[0]}, cols: {turned[1]}."


def _largest(image: np.ndarray) -> list[tuple[int, int]]:
    """Inner corners of the sides, the shorter first, of the largest checkerboard that OpenCV finds; [] if none."""
    cv2 = load_cv2()
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    found, _, meta = cv2.findChessboardCornersSBWithMeta(image, (_LEAST_SIDE, _LEAST_SIDE), flags)
    return [(min(meta.shape), max(meta.shape))] if found else []


def _count(images: list[np.ndarray], size: tuple[int, int]) -> int:
    """In how many images a checkerboard of `size` (rows, cols) inner corners is found."""
    detector = CheckerboardDetector(*size)
    return sum(bool(detector.detect(image).kept.any()) for image in images)


def other_columns(images: Iterable[np.ndarray], board: AprilGrid | Charuco) -> str:
    """A sentence where the tags in the images (h, w) uint8 stand as on a board with another number of columns.

    "" where the first five images show the stated layout, or too few tags to tell. Each number of columns gives every
    id a place on the board; the layout with the least misfit to a homography wins.
    """
    across, down = ("cols", "rows") if isinstance(board, AprilGrid) else ("squares_x", "squares_y")
    seen = [_tags_of(View(image), board) for image in islice(images, _MOST_IMAGES)]
    stated, other = getattr(board, across), getattr(board, down)
    misfit = {n: min(_misfit(seen, c) for c in _with_columns(board, n)) for n in range(3, _MOST_COLUMNS + 1)}
    best = min(misfit, key=lambda n: misfit[n])
    wrong = misfit.get(stated, np.inf) > max(_MOST_RIGHT, misfit[best] / _MOST_RATIO)
    if not (wrong and misfit[best] < _MOST_BEST):
        return ""
    if best == other:
        return f"{down} and {across} are swapped; write {down}: {stated}, {across}: {other}."
    return f"the tags stand as on a board with {across}: {best}, not {stated}; correct {down} and {across}."


def _with_columns(board: AprilGrid | Charuco, n: int) -> list[np.ndarray]:
    """The boards that have n tags (AprilGrid) or squares (ChArUco) in a row: (tags, 4, 2) corners of their tags.

    The unit is the tag's side or the square's. A ChArUco board has two layouts, OpenCV's today and its older one.
    """
    if isinstance(board, AprilGrid):
        return [grid_tags(-(-board.rows * board.cols // n), n, board.tag_spacing)]
    dark, ratio = dark_squares(max(board.squares_x, board.squares_y), n, False), board.marker_size / board.square_size
    return [charuco_tags(dark, ratio), charuco_tags(~dark, ratio)]


def _tags_of(view: View, board: AprilGrid | Charuco) -> tuple[np.ndarray, np.ndarray]:
    """Ids (m,), from the board's first on, of the tags that the image shows once, and their corners (m, 4, 2) px."""
    if isinstance(board, AprilGrid):
        tags = find_tags(view, tag_family(board.family), board.border_bits, view.windows[0], board.squares)
        place = tags.ids - board.first_id
    else:
        view = View(255 - view.image) if board.inverted else view
        tags = all_tags(view, tag_family(board.dictionary), 1)
        place = tags.ids
    _, index, count = np.unique(place, return_index=True, return_counts=True)
    rows = index[count == 1]
    rows = rows[place[rows] >= 0]
    return place[rows], tags.quads[rows]


def _misfit(seen: list[tuple[np.ndarray, np.ndarray]], corners: np.ndarray) -> float:
    """Distance of the tags' corners from where one homography of the layout puts them, in sides of a tag in the image.

    seen: of each image what `_tags_of` gives; corners (tags, 4, 2): the layout. It is the median over images of the
    median over an image; inf where no image shows six tags of the layout.
    """
    found = []
    for place, quads in seen:
        on = place < len(corners)
        if on.sum() < _LEAST_TAGS:
            continue
        xy, uv = corners[place[on]].reshape(-1, 2), quads[on].reshape(-1, 2)
        H = fit_homography(xy, uv, len(xy))
        placed = np.array([mapped(H, x, y) for x, y in xy])
        side = np.median(np.linalg.norm(np.diff(quads[on], axis=1), axis=2))
        found.append(float(np.median(np.linalg.norm(placed - uv, axis=1)) / side))
    return float(np.median(found)) if found else np.inf
