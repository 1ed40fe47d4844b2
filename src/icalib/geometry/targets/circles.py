"""Grids of circles, symmetric and asymmetric, as OpenCV and Kalibr define them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from icalib.errors import RigError
from icalib.geometry.targets.base import UntaggedTarget


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
