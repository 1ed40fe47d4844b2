"""Checkerboards."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from icalib.errors import RigError
from icalib.geometry.targets.base import Target, untagged_index


@dataclass(frozen=True)
class Checkerboard(Target):
    """`rows` x `cols` INNER corners between squares of edge `square_size` [m], the bottom left square black, as Kalibr
    prints it; `inverted`: white.

    Points row by row from the bottom left, row r and column c at index r cols + c. Raises RigError for fewer than two
    rows or columns.
    """

    type: ClassVar[str] = "checkerboard"
    blooms: ClassVar[bool] = False
    seldom: ClassVar[tuple[str, ...]] = ("inverted",)

    rows: int
    cols: int
    square_size: float
    inverted: bool = False

    def __post_init__(self) -> None:
        if min(self.rows, self.cols) < 2:
            raise RigError(
                f"a checkerboard of {self.rows} x {self.cols} inner corners cannot tell x from y; "
                "correct rows and cols, which count inner corners."
            )

    @property
    def symmetric(self) -> bool:
        """rows and cols both even or both odd: a half turn puts black on black."""
        return (self.rows + self.cols) % 2 == 0

    @cached_property
    def points(self) -> np.ndarray:
        """(rows cols, 3) inner corners in metres."""
        row, col = np.divmod(np.arange(self.rows * self.cols), self.cols)
        return self.square_size * np.stack([col, row, 0 * row], axis=1)

    def point_index(self, tag_id: np.ndarray, corner: np.ndarray) -> np.ndarray:
        return untagged_index(tag_id, corner, len(self.points), "rows and cols")

    def point_identity(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros_like(index), index
