"""ChArUco boards: a checkerboard with a small tag in each white square."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from icalib.errors import RigError
from icalib.geometry.targets.base import UntaggedTarget
from icalib.geometry.targets.families import TagSet, checked_family


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
