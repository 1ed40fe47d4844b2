"""Kalibr's AprilGrid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from icalib.errors import RecordingError
from icalib.geometry.targets.base import UNIT_TAG, TagTarget
from icalib.geometry.targets.families import APRILGRID_FAMILY, TagSet, checked_family


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
