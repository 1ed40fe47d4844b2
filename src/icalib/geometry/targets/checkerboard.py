"""Checkerboards."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from icalib.errors import RigError
from icalib.geometry.targets.base import UntaggedTarget


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
