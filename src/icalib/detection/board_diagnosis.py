"""Boards of another size than the rig file says: which one the images show, in a sentence that says what to write."""

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

_MOST_IMAGES = 5
_LEAST_SIDE = 3  # corners, of a board that can be found
_MOST_COLUMNS = 20  # tags or squares in a row
_LEAST_TAGS = 6  # in an image, that show how a board is laid out
_CLEARLY_BETTER = 0.5  # of the misfit in the layout that was stated
_WRONG = 0.1  # tags: the misfit of a layout that needs no other
_FITS = 0.3  # tags: the misfit of a layout that may be the right one


def other_size(images: Iterable[np.ndarray], board: Checkerboard) -> str:
    """A sentence on the checkerboard in the first images (h, w) uint8, in which none of the stated size was found; ""
    where there is none of another size either."""
    grey = [255 - i if board.inverted else i for i in islice(images, _MOST_IMAGES)]
    stated = (min(board.rows, board.cols), max(board.rows, board.cols))
    counted = (stated[0] - 1, stated[1] - 1)
    sizes = ({counted} | {size for image in grey for size in _largest(image)}) - {stated}
    seen = {size: _count(grey, size) for size in sorted(sizes) if size[0] >= _LEAST_SIDE}
    if not any(seen.values()):
        return ""
    rows, cols = max(seen, key=lambda size: (seen[size], size == counted, size))
    turned = (cols, rows) if board.rows > board.cols else (rows, cols)
    what = f"a checkerboard of {turned[0]} x {turned[1]} inner corners is in {seen[rows, cols]} of {len(grey)} of them"
    why = "rows and cols count INNER corners, not squares; " if (rows, cols) == counted else ""
    return f"{what}; {why}write rows: {turned[0]}, cols: {turned[1]}."


def _largest(image: np.ndarray) -> list[tuple[int, int]]:
    """Rows and columns, the smaller number first, of the checkerboard that OpenCV finds, if any."""
    cv2 = load_cv2()
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    found, _, meta = cv2.findChessboardCornersSBWithMeta(image, (_LEAST_SIDE, _LEAST_SIDE), flags)
    return [(min(meta.shape), max(meta.shape))] if found else []


def _count(images: list[np.ndarray], size: tuple[int, int]) -> int:
    detector = CheckerboardDetector(*size)
    return sum(bool(detector.detect(image).kept.any()) for image in images)


def other_columns(images: Iterable[np.ndarray], board: AprilGrid | Charuco) -> str:
    """A sentence where the tags in the first images (h, w) uint8 stand as in rows of another length; "" where they
    stand as on the board, or too few are seen to tell."""
    across, down = ("cols", "rows") if isinstance(board, AprilGrid) else ("squares_x", "squares_y")
    seen = [_tags_of(View(image), board) for image in islice(images, _MOST_IMAGES)]
    stated, other = getattr(board, across), getattr(board, down)
    misfit = {n: min(_misfit(seen, c) for c in _with_columns(board, n)) for n in range(3, _MOST_COLUMNS + 1)}
    best = min(misfit, key=lambda n: misfit[n])
    if not (misfit.get(stated, np.inf) > max(_WRONG, misfit[best] / _CLEARLY_BETTER) and misfit[best] < _FITS):
        return ""
    if best == other:
        return f"{down} and {across} are swapped; write {down}: {stated}, {across}: {other}."
    return f"the tags stand as on a board with {across}: {best}, not {stated}; correct {down} and {across}."


def _with_columns(board: AprilGrid | Charuco, n: int) -> list[np.ndarray]:
    """(tags, 4, 2) corners of the tags on a board with rows of n tags or squares, in any unit; of a ChArUco board in
    both layouts."""
    if isinstance(board, AprilGrid):
        return [grid_tags(-(-board.rows * board.cols // n), n, board.tag_spacing)]
    dark, ratio = dark_squares(max(board.squares_x, board.squares_y), n, False), board.marker_size / board.square_size
    return [charuco_tags(dark, ratio), charuco_tags(~dark, ratio)]


def _tags_of(view: View, board: AprilGrid | Charuco) -> tuple[np.ndarray, np.ndarray]:
    """Places (m,) on the board, by their ids, of the tags that are seen once, and their corners (m, 4, 2) px."""
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
    """How far the tags' corners are from where one homography puts them, over the tags' size: the median over the
    images of the median over an image; inf where too few tags are seen to tell."""
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
