"""What is printed: each target as black and white rectangles, for those who print and those who render it."""

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
from icalib.geometry.targets.tag import Tag

_SAME_M = 1e-9  # edges this close are one
_Box = tuple[float, float, float, float, bool]  # left, bottom, right, top [m]; white


@dataclass(frozen=True, eq=False)
class Pattern:
    """Cells between increasing edges x (nx + 1,) and y (ny + 1,) [m, board frame]; white (ny, nx) bool, row 0 at the
    bottom."""

    x: np.ndarray
    y: np.ndarray
    white: np.ndarray

    def with_margin(self, margin: float) -> Pattern:
        """The pattern on white paper that reaches `margin` [m] beyond it on all sides."""
        if margin <= 0.0:
            return self
        x, y = (np.concatenate([[e[0] - margin], e, [e[-1] + margin]]) for e in (self.x, self.y))
        return Pattern(x, y, np.pad(self.white, 1, constant_values=True))

    def black_boxes(self) -> np.ndarray:
        """(n, 4) left, bottom, right, top [m] of rectangles that together are the black, none overlapping."""
        boxes: list[tuple[int, int, int, int]] = []
        open_runs: dict[tuple[int, int], int] = {}
        for row in range(len(self.white) + 1):
            runs = _runs(~self.white[row]) if row < len(self.white) else set()
            boxes += [(a, first, b, row) for (a, b), first in open_runs.items() if (a, b) not in runs]
            open_runs = {run: open_runs.get(run, row) for run in runs}
        i = np.array(sorted(boxes), dtype=np.int64).reshape(-1, 4)
        return np.stack([self.x[i[:, 0]], self.y[i[:, 1]], self.x[i[:, 2]], self.y[i[:, 3]]], axis=1)


def pattern_of(target: Target, border_bits: int | None = None) -> Pattern:
    """The print of `target`. border_bits: width of the tags' black border in bits; by default an AprilGrid's
    own, and 1 elsewhere.

    Raises CalibrationError where the bits of tags are needed and OpenCV is not installed, RigError where there is no
    such print.
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
    """White, as far as the circles reach: they are no rectangles."""
    radius = 0.5 * grid.diameter
    x, y = (np.array([a.min() - radius, a.max() + radius]) for a in grid.points[:, :2].T)
    return Pattern(x, y, np.ones((1, 1), dtype=bool))


def _in_colours(pattern: Pattern, inverted: bool) -> Pattern:
    return replace(pattern, white=~pattern.white) if inverted else pattern


def _aprilgrid(grid: AprilGrid, border_bits: int) -> list[_Box]:
    """Tags, and a black square of the gap's width at each corner of each tag, outside too."""
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
    size, marker = board.square_size, board.marker_size
    left, top = -size, size  # of the board, whose first inner corner is the origin
    nx, ny = board.squares_x, board.squares_y
    # Where the top left square is black, the one at the bottom left is, too, if the number of rows is odd.
    boxes = _squares(nx, ny, size, (left, top - ny * size), (1 - ny % 2 + board.first_white) % 2)
    white = [(row, col) for row in range(ny) for col in range(nx) if (row + col + board.first_white) % 2 == 1]
    inset, bits = 0.5 * (size - marker), opencv_bits(board.dictionary)  # AprilTags rotated by 180 deg, as OpenCV does
    for tag_id, (row, col) in enumerate(white):
        corner = left + col * size + inset, top - (row + 1) * size + inset
        boxes += _tag(bits[tag_id], marker, corner, border_bits)
    return boxes


def _squares(nx: int, ny: int, size: float, corner: tuple[float, float], parity: int) -> list[_Box]:
    """Squares from `corner` (left, bottom) on, black where column + row has `parity`."""
    x, y = ((c + size * np.arange(n + 1)).tolist() for c, n in zip(corner, (nx, ny), strict=True))
    return [(x[i], y[j], x[i + 1], y[j + 1], (i + j) % 2 != parity) for j in range(ny) for i in range(nx)]


def _tag(bits: np.ndarray, size: float, corner: tuple[float, float], border_bits: int) -> list[_Box]:
    """One tag of bits (n, n), row 0 at the top, its black border included; `corner` is its left and bottom."""
    bits = bits[::-1]
    n = len(bits) + 2 * border_bits
    x, y = ((c + size * np.arange(n + 1) / n).tolist() for c in corner)
    boxes: list[_Box] = [(x[0], y[0], x[-1], y[-1], False)]
    for row, col in (np.argwhere(bits) + border_bits).tolist():
        boxes.append((x[col], y[row], x[col + 1], y[row + 1], True))
    return boxes


def _rasterised(boxes: list[_Box]) -> Pattern:
    """Later boxes cover earlier ones; paper that none covers is white."""
    sides = np.array([box[:4] for box in boxes])
    x, y = _edges(sides[:, [0, 2]].ravel()), _edges(sides[:, [1, 3]].ravel())
    column, row = (np.searchsorted(e, sides[:, k] - _SAME_M) for e, k in ((x, [0, 2]), (y, [1, 3])))
    white = np.ones((len(y) - 1, len(x) - 1), dtype=bool)
    for i, box in enumerate(boxes):
        white[row[i, 0] : row[i, 1], column[i, 0] : column[i, 1]] = box[4]
    return Pattern(x, y, white)


def _edges(values: np.ndarray) -> np.ndarray:
    values = np.sort(values)
    return values[np.diff(values, prepend=-np.inf) > _SAME_M]


def _runs(row: np.ndarray) -> set[tuple[int, int]]:
    """(first, behind last) of each run of True."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(np.int8)))
    return {(int(a), int(b)) for a, b in zip(change[::2], change[1::2], strict=True)}
