"""Printed patterns of targets as black and white rectangles, for printing and rendering."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import RigError
from icalib.geometry.targets.aprilgrid import AprilGrid
from icalib.geometry.targets.base import Target
from icalib.geometry.targets.charuco import Charuco
from icalib.geometry.targets.checkerboard import Checkerboard
from icalib.geometry.targets.circles import Circles
from icalib.geometry.targets.families import opencv_bits, tag_bits
from icalib.geometry.targets.markers import Tag

_SAME_M = 1e-9  # edges at most this far apart are merged
_Box = tuple[float, float, float, float, bool]  # left, bottom, right, top [m]; white


@dataclass(frozen=True, eq=False)
class Pattern:
    """Grid of black and white cells. x (nx + 1,), y (ny + 1,): increasing positions of the edges [m] in the board
    frame; white (ny, nx) bool, row 0 at the bottom."""

    x: np.ndarray
    y: np.ndarray
    white: np.ndarray

    def with_margin(self, margin: float) -> Pattern:
        """The pattern with a white margin of width `margin` [m] on all sides."""
        if margin <= 0.0:
            return self
        x, y = (np.concatenate([[e[0] - margin], e, [e[-1] + margin]]) for e in (self.x, self.y))
        return Pattern(x, y, np.pad(self.white, 1, constant_values=True))

    def black_boxes(self) -> np.ndarray:
        """(n, 4) left, bottom, right, top [m] of disjoint rectangles that cover the black area."""
        boxes: list[tuple[int, int, int, int]] = []
        open_runs: dict[tuple[int, int], int] = {}
        for row in range(len(self.white) + 1):
            runs = _runs(~self.white[row]) if row < len(self.white) else set()
            boxes += [(a, first, b, row) for (a, b), first in open_runs.items() if (a, b) not in runs]
            open_runs = {run: open_runs.get(run, row) for run in runs}
        i = np.array(sorted(boxes), dtype=np.int64).reshape(-1, 4)
        return np.stack([self.x[i[:, 0]], self.y[i[:, 1]], self.x[i[:, 2]], self.y[i[:, 3]]], axis=1)


def pattern_of(target: Target, border_bits: int | None = None) -> Pattern:
    """The printed pattern of `target`. border_bits: width of the tags' black border in bits. The default is
    `border_bits` of an AprilGrid, and 1 otherwise.

    Raises CalibrationError if bits of tags are needed and OpenCV is not installed, RigError if the target cannot be
    printed.
    """
    if border_bits is not None and border_bits < 1:
        raise RigError(f"a border of {border_bits} bits leaves no edge to see; give 1 or 2.")
    if isinstance(target, AprilGrid):
        return _rasterised(_aprilgrid(target, border_bits or target.border_bits))
    if isinstance(target, Charuco):
        return _in_colours(_rasterised(_charuco(target, border_bits or 1)), target.inverted)
    if isinstance(target, Checkerboard):
        corner = (-target.square_size, -target.square_size)
        squares = _squares(target.cols + 1, target.rows + 1, target.square_size, corner, 0)
        return _in_colours(_rasterised(squares), target.inverted)
    if isinstance(target, Circles):
        return _paper(target)
    if isinstance(target, Tag):
        return _rasterised(_tag(tag_bits(target.family, target.id), target.size, (0.0, 0.0), border_bits or 1))
    raise RigError(f"icalib cannot print targets of type {target.type}; choose another type.")


def _paper(grid: Circles) -> Pattern:
    """A white area that contains all circles, as circles cannot be represented by rectangles."""
    radius = 0.5 * grid.diameter
    x, y = (np.array([a.min() - radius, a.max() + radius]) for a in grid.points[:, :2].T)
    return Pattern(x, y, np.ones((1, 1), dtype=bool))


def _in_colours(pattern: Pattern, inverted: bool) -> Pattern:
    """The pattern, with black and white exchanged if `inverted`."""
    return replace(pattern, white=~pattern.white) if inverted else pattern


def _aprilgrid(grid: AprilGrid, border_bits: int) -> list[_Box]:
    """Tags, and a black square with the width of the gap at each corner of each tag, including the outer corners."""
    size, gap = grid.tag_size, grid.tag_size * grid.tag_spacing
    pitch, boxes = size + gap, []
    for i in range(grid.rows * grid.cols):
        row, col = divmod(i, grid.cols)
        boxes += _tag(tag_bits(grid.family, grid.first_id + i), size, (col * pitch, row * pitch), border_bits)
    corners = [(row, col) for row in range(grid.rows + 1) for col in range(grid.cols + 1)] if grid.squares else []
    for row, col in corners:
        left, bottom = col * pitch - gap, row * pitch - gap
        boxes.append((left, bottom, left + gap, bottom + gap, False))
    return boxes


def _charuco(board: Charuco, border_bits: int) -> list[_Box]:
    """Squares of the checkerboard, and a tag in each white square."""
    size, marker = board.square_size, board.marker_size
    left, top = -size, size  # of the board; the first inner corner is the origin
    nx, ny = board.squares_x, board.squares_y
    # If the number of rows is odd, the squares at the top left and the bottom left have the same colour.
    boxes = _squares(nx, ny, size, (left, top - ny * size), (1 - ny % 2 + board.first_white) % 2)
    white = [(row, col) for row in range(ny) for col in range(nx) if (row + col + board.first_white) % 2 == 1]
    inset, bits = 0.5 * (size - marker), opencv_bits(board.dictionary)  # AprilTags rotated by 180 deg, as OpenCV does
    for tag_id, (row, col) in enumerate(white):
        corner = left + col * size + inset, top - (row + 1) * size + inset
        boxes += _tag(bits[tag_id], marker, corner, border_bits)
    return boxes


def _squares(nx: int, ny: int, size: float, corner: tuple[float, float], parity: int) -> list[_Box]:
    """nx x ny squares, from `corner` (left, bottom). A square is black if column + row has the parity `parity`."""
    x, y = ((c + size * np.arange(n + 1)).tolist() for c, n in zip(corner, (nx, ny), strict=True))
    return [(x[i], y[j], x[i + 1], y[j + 1], (i + j) % 2 != parity) for j in range(ny) for i in range(nx)]


def _tag(bits: np.ndarray, size: float, corner: tuple[float, float], border_bits: int) -> list[_Box]:
    """One tag with bits (n, n), row 0 at the top, including its black border. corner: its left and bottom [m]."""
    bits = bits[::-1]
    n = len(bits) + 2 * border_bits
    x, y = ((c + size * np.arange(n + 1) / n).tolist() for c in corner)
    boxes: list[_Box] = [(x[0], y[0], x[-1], y[-1], False)]
    for row, col in (np.argwhere(bits) + border_bits).tolist():
        boxes.append((x[col], y[row], x[col + 1], y[row + 1], True))
    return boxes


def _rasterised(boxes: list[_Box]) -> Pattern:
    """Pattern of the boxes. Later boxes cover earlier ones; the area outside all boxes is white."""
    sides = np.array([box[:4] for box in boxes])
    x, y = _edges(sides[:, [0, 2]].ravel()), _edges(sides[:, [1, 3]].ravel())
    column, row = (np.searchsorted(e, sides[:, k] - _SAME_M) for e, k in ((x, [0, 2]), (y, [1, 3])))
    white = np.ones((len(y) - 1, len(x) - 1), dtype=bool)
    for i, box in enumerate(boxes):
        white[row[i, 0] : row[i, 1], column[i, 0] : column[i, 1]] = box[4]
    return Pattern(x, y, white)


def _edges(values: np.ndarray) -> np.ndarray:
    """Sorted values without repetitions closer than `_SAME_M`."""
    values = np.sort(values)
    return values[np.diff(values, prepend=-np.inf) > _SAME_M]


def _runs(row: np.ndarray) -> set[tuple[int, int]]:
    """(first, one past the last) index of each run of True."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(np.int8)))
    return {(int(a), int(b)) for a, b in zip(change[::2], change[1::2], strict=True)}
