"""Boards and tags as targets: their points, and how they are told apart and drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from icalib.errors import RecordingError, RigError
from icalib.geometry.targets.base import UNIT_TAG, TagTarget, Target, UntaggedTarget
from icalib.geometry.targets.families import APRILGRID_FAMILY, FAMILIES, TagSet, checked_family, opencv_bits, tag_bits

# Kalibr's AprilGrid.


@dataclass(frozen=True)
class AprilGrid(TagTarget):
    """Kalibr's AprilGrid: `rows` x `cols` tags with edge `tag_size` [m], with gaps of `tag_spacing` * tag_size.

    Board frame: origin at corner 0 of the first tag, x along a row, y along a column, all tags in z = 0. Tag ids are
    row-major from the bottom left and start with `first_id`. Corner 0 of a tag is at its bottom left; the others follow
    counterclockwise. border_bits: width of the black border, 2 as in Kalibr, or 1. squares: whether black squares fill
    the gaps between the corners of tags. Raises RigError if the family has too few tags.
    """

    type: ClassVar[str] = "aprilgrid"
    seldom: ClassVar[tuple[str, ...]] = ("first_id", "family")

    rows: int
    cols: int
    tag_size: float
    tag_spacing: float
    border_bits: int = 2
    squares: bool = True
    first_id: int = 0
    family: str = APRILGRID_FAMILY

    def __post_init__(self) -> None:
        object.__setattr__(self, "family", checked_family(self.family, self.first_id + self.rows * self.cols))

    @cached_property
    def points(self) -> np.ndarray:
        """(4 * rows * cols, 3) corners [m]; corner c of tag number i has index 4 i + c."""
        pitch = self.tag_size * (1.0 + self.tag_spacing)
        row, col = np.divmod(np.arange(self.rows * self.cols), self.cols)
        origin = pitch * np.stack([col, row, 0 * row], axis=1)
        return (origin[:, None] + self.tag_size * UNIT_TAG).reshape(-1, 3)

    @property
    def tags(self) -> TagSet:
        return TagSet(self.family, self.border_bits, tuple(self.first_id + i for i in range(self.rows * self.cols)))

    def tag_numbers(self, tag_id: np.ndarray) -> np.ndarray:
        first, last = self.first_id, self.first_id + self.rows * self.cols - 1
        bad = (tag_id < first) | (tag_id > last)
        if bad.any():
            raise RecordingError(
                f"tag {tag_id[bad][0]} is not on the target ({self.rows} x {self.cols} tags, ids {first} to {last}); "
                "check rows, cols and first_id in the rig file."
            )
        return tag_id - first

    def point_identity(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.first_id + index // 4, index % 4


# ChArUco boards: a checkerboard with a small tag in each white square.


@dataclass(frozen=True)
class Charuco(UntaggedTarget):
    """OpenCV's ChArUco board: `squares_x` x `squares_y` squares with edge `square_size` [m], and a tag in each white
    square.

    The top left square is black (OpenCV 4.6 and later). Tags have the edge `marker_size` [m] and are of `dictionary`,
    with ids row by row from the top. legacy: the layout of OpenCV before 4.6 and of calib.io, whose top left square is
    white if squares_y is even. inverted: black and white are exchanged.

    Points are the inner corners, numbered as in OpenCV: row by row from the top left. Point 0 is the origin, so that y
    of later rows is negative. Raises RigError if sizes or dictionary are not possible.
    """

    type: ClassVar[str] = "charuco"
    sizes: ClassVar[str] = "squares_x and squares_y"
    seldom: ClassVar[tuple[str, ...]] = ("legacy", "inverted")

    squares_x: int
    squares_y: int
    square_size: float
    marker_size: float
    dictionary: str
    legacy: bool = False
    inverted: bool = False

    def __post_init__(self) -> None:
        if min(self.squares_x, self.squares_y) < 3:
            raise RigError(
                f"a ChArUco board of {self.squares_x} x {self.squares_y} squares has too few inner corners; "
                "it needs 3 squares each way."
            )
        if not self.marker_size < self.square_size:
            raise RigError(
                f"marker_size {self.marker_size:g} does not fit a square of {self.square_size:g}; "
                "correct marker_size or square_size."
            )
        object.__setattr__(self, "dictionary", checked_family(self.dictionary, self.squares_x * self.squares_y // 2))

    @property
    def first_white(self) -> int:
        """Whether the top left square is white (1) or black (0)."""
        return int(self.legacy and self.squares_y % 2 == 0)

    @cached_property
    def points(self) -> np.ndarray:
        """((squares_x - 1) (squares_y - 1), 3) inner corners [m]."""
        row, col = np.divmod(np.arange((self.squares_x - 1) * (self.squares_y - 1)), self.squares_x - 1)
        return self.square_size * np.stack([col, -row, 0 * row], axis=1)

    @property
    def tags(self) -> TagSet:
        return TagSet(self.dictionary, 1, tuple(range(self.squares_x * self.squares_y // 2)))


# Checkerboards.


@dataclass(frozen=True)
class Checkerboard(UntaggedTarget):
    """Checkerboard with `rows` x `cols` INNER corners between squares with edge `square_size` [m].

    The bottom left square is black, as in Kalibr, or white if `inverted`. upright: the rows run to the right in all
    images, within 90 degrees, or 45 if rows = cols; this resolves the symmetry of a board. Points are ordered row by
    row from the bottom left, with index r cols + c in row r and column c. Raises RigError for fewer than two rows or
    columns.
    """

    type: ClassVar[str] = "checkerboard"
    seldom: ClassVar[tuple[str, ...]] = ("inverted", "upright")

    rows: int
    cols: int
    square_size: float
    inverted: bool = False
    upright: bool = False

    def __post_init__(self) -> None:
        if min(self.rows, self.cols) < 2:
            raise RigError(
                f"a checkerboard of {self.rows} x {self.cols} inner corners cannot tell x from y; "
                "correct rows and cols, which count inner corners."
            )

    @cached_property
    def turns(self) -> tuple[np.ndarray, ...]:
        """Rotations in the plane that leave the pattern unchanged, see `Target.turns`.

        Half a turn if rows and cols are both even or both odd; also quarter turns if they are equal and even. Only the
        identity if `upright`, or if one is even and the other odd."""
        number = np.arange(self.rows * self.cols).reshape(self.rows, self.cols)
        if self.upright or (self.rows + self.cols) % 2 == 1:
            return (number.ravel(),)
        quarters = range(4) if self.rows == self.cols and self.rows % 2 == 0 else (0, 2)
        return tuple(np.rot90(number, k).ravel() for k in quarters)

    @cached_property
    def points(self) -> np.ndarray:
        """(rows cols, 3) inner corners [m]."""
        row, col = np.divmod(np.arange(self.rows * self.cols), self.cols)
        return self.square_size * np.stack([col, row, 0 * row], axis=1)


# Grids of circles, symmetric and asymmetric, as OpenCV and Kalibr define them.


@dataclass(frozen=True)
class Circles(UntaggedTarget):
    """`rows` x `cols` black circles with `diameter` [m] on white.

    In a symmetric grid the centres of neighbours are `spacing` [m] apart. In an `asymmetric` grid, rows are one spacing
    apart, and circles in a row two. Every second row is shifted by one spacing to the right.

    Points are the centres, numbered row by row from the top left. Point 0 is the origin, and y points up, so that y of
    later rows is negative. Raises RigError if circles would touch, or are too few.
    """

    type: ClassVar[str] = "circles"
    seldom: ClassVar[tuple[str, ...]] = ("asymmetric",)

    rows: int
    cols: int
    spacing: float
    diameter: float
    asymmetric: bool = False

    def __post_init__(self) -> None:
        if min(self.rows, self.cols) < 2 or self.rows * self.cols < 6:
            raise RigError(f"a grid of {self.rows} x {self.cols} circles has too few; it needs 2 x 3 at least.")
        nearest = self.spacing * (np.sqrt(2.0) if self.asymmetric else 1.0)
        if not self.diameter < nearest:
            raise RigError(
                f"circles of diameter {self.diameter:g} m, {nearest:g} m apart, touch; correct diameter or spacing."
            )

    @cached_property
    def points(self) -> np.ndarray:
        """(rows * cols, 3) centres [m]; z = 0."""
        row, col = np.divmod(np.arange(self.rows * self.cols), self.cols)
        across = 2 * col + row % 2 if self.asymmetric else col
        return self.spacing * np.stack([across, -row, 0 * row], axis=1)

    @cached_property
    def radii(self) -> np.ndarray:
        """(rows * cols,) radii [m]."""
        return np.full(self.rows * self.cols, 0.5 * self.diameter)

    @cached_property
    def turns(self) -> tuple[np.ndarray, ...]:
        """Rotations in the plane that leave the pattern unchanged, see `Target.turns`.

        Symmetric grids: half a turn, and quarter turns if rows = cols. Asymmetric grids: half a turn if rows are even,
        otherwise only the identity.
        """
        number = np.arange(self.rows * self.cols).reshape(self.rows, self.cols)
        if self.asymmetric:
            quarters = (0, 2) if self.rows % 2 == 0 else (0,)
        else:
            quarters = range(4) if self.rows == self.cols else (0, 2)
        return tuple(np.rot90(number, k).ravel() for k in quarters)


# Separate tags of one family and size at unknown poses.
#
# A single tag, on a wall or on a robot.


@dataclass(frozen=True)
class Markers(TagTarget):
    """Tags of `family` with these `ids`, or with all ids of the family if none are given. size: edge of the black
    border [m].

    Each tag is a separate body. Corners are numbered as on an AprilGrid: 0 at the bottom left, then counterclockwise.
    Raises RigError if the family lacks such a tag, or an id is listed twice.
    """

    type: ClassVar[str] = "markers"

    family: str
    size: float
    ids: tuple[int, ...] = ()
    border_bits: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "family", checked_family(self.family, 1 + max(self.ids, default=0)))
        if repeated := [i for i in self.ids if self.ids.count(i) > 1]:
            raise RigError(f"tag {repeated[0]} is listed twice; each id may stand in one place only.")

    @cached_property
    def known(self) -> np.ndarray:
        """(tags,) int64 ids, increasing."""
        return np.array(sorted(self.ids) or range(FAMILIES[self.family][1]), dtype=np.int64)

    @cached_property
    def points(self) -> np.ndarray:
        """(4 tags, 3) corners [m], each in the frame of its tag; corner c of tag known[i] has index 4 i + c."""
        return np.tile(self.size * UNIT_TAG, (len(self.known), 1))

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        return tuple(f"tag {i}" for i in self.known)

    @cached_property
    def body(self) -> np.ndarray:
        return np.repeat(np.arange(len(self.known)), 4)

    @cached_property
    def bends(self) -> np.ndarray:
        return np.zeros(len(self.known), dtype=bool)

    @property
    def tags(self) -> TagSet:
        return TagSet(self.family, self.border_bits, tuple(self.known.tolist()))

    def tag_numbers(self, tag_id: np.ndarray) -> np.ndarray:
        place = np.minimum(np.searchsorted(self.known, tag_id), len(self.known) - 1)
        if (strange := self.known[place] != tag_id).any():
            raise RecordingError(f"tag {tag_id[strange][0]} is not one of the target's ids; add it, or leave it out.")
        return place

    def point_identity(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.known[index // 4], index % 4


@dataclass(frozen=True)
class Tag(TagTarget):
    """Tag `id` of `family` (any name that `family_name` accepts). size: edge of the black border [m].

    Corners are numbered as on an AprilGrid: 0 at the bottom left, then counterclockwise. Raises RigError if there is no
    such tag.
    """

    type: ClassVar[str] = "tag"

    family: str
    id: int
    size: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "family", checked_family(self.family, self.id + 1))

    @cached_property
    def points(self) -> np.ndarray:
        """(4, 3) corners [m]."""
        return self.size * UNIT_TAG

    def tag_numbers(self, tag_id: np.ndarray) -> np.ndarray:
        if (tag_id != self.id).any():
            raise RecordingError(f"tag {tag_id[tag_id != self.id][0]} is not tag {self.id}; leave it out.")
        return np.zeros_like(tag_id)

    def point_identity(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full_like(index, self.id), index


# Printed patterns of targets as black and white rectangles, for printing and rendering.

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
