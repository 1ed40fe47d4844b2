"""What the rest of the program knows of a target: this class and nothing else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from icalib.errors import RecordingError
from icalib.geometry.targets.families import TagSet

BOARD = "board0"
# Of a printed size, relative: a ruler reads 0.2 mm of 100 mm, and printers and damp paper are off by as much.
SIZE_SIGMA = 0.002


@dataclass(frozen=True)
class Target(ABC):
    """Points on flat, rigid bodies: one, unless said otherwise. The frame of a body: origin at its first point, x to
    the right and y upwards on the sheet, so that z points out of the print towards whoever looks at it; all points
    have z = 0.

    A point is identified by the id of a tag and its corner, or by tag 0 and the number of the corner on targets whose
    points belong to no tag. type: the name in rig files. blooms: the points are corners of tags, which bloom pulls
    towards the tag's centre; where squares touch corner to corner it moves nothing. seldom: fields that `plain` leaves
    out at their defaults.
    """

    type: ClassVar[str]
    blooms: ClassVar[bool]
    seldom: ClassVar[tuple[str, ...]] = ()

    size_sigma: float = field(default=SIZE_SIGMA, kw_only=True)  # of all its lengths, relative; 0: exact

    @cached_property
    @abstractmethod
    def points(self) -> np.ndarray:
        """(n, 3) in metres, in the frame of the body that each belongs to."""

    @cached_property
    def tag_centers(self) -> np.ndarray:
        """(n, 3) in metres: for each point the centre of its tag; the point itself where nothing blooms."""
        return self.points

    @cached_property
    def radii(self) -> np.ndarray:
        """(n,) in metres: of the circle whose centre each point is; 0 of points that are no circle's."""
        return np.zeros(len(self.points))

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """Name of each rigid body. How several stand to each other is unknown, and estimated."""
        return (BOARD,)

    @cached_property
    def body(self) -> np.ndarray:
        """(n,) int64: the body that each point belongs to."""
        return np.zeros(len(self.points), dtype=np.int64)

    @cached_property
    def tag_number(self) -> np.ndarray:
        """(n,) int64: the same for all corners of one tag, which are found together; corners without a tag have a
        number each."""
        return np.arange(len(self.points))

    @cached_property
    def bends(self) -> np.ndarray:
        """(bodies,) bool: whether a body is large enough to bend."""
        return np.ones(len(self.bodies), dtype=bool)

    @property
    def tags(self) -> TagSet | None:
        """The tags by which images tell this target from others, where it has any."""
        return None

    def plain(self) -> dict[str, Any]:
        """Its fields as a rig file has them: text, numbers, lists; those that list nothing are left out."""
        usual = {f.name: f.default for f in fields(self) if f.name in (*self.seldom, "size_sigma")}
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        values = {name: value for name, value in values.items() if name not in usual or value != usual[name]}
        lists = {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
        return {"type": self.type} | {name: value for name, value in lists.items() if value != []}

    @cached_property
    def turns(self) -> tuple[np.ndarray, ...]:
        """Numbers (n,) of the points after each turn of the sheet that no image shows; the first is no turn."""
        return (np.arange(len(self.points)),)

    @property
    def symmetric(self) -> bool:
        """Whether images show the target alike after some turn, so that they cannot tell its points apart."""
        return len(self.turns) > 1

    @abstractmethod
    def point_index(self, tag_id: np.ndarray, corner: np.ndarray) -> np.ndarray:
        """(N,) index into `points` of (N,) tags and corners. Raises RecordingError for one that the target lacks."""

    @abstractmethod
    def point_identity(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,) tag ids and (N,) corners of (N,) indices into `points`."""


def untagged_index(tag_id: np.ndarray, corner: np.ndarray, n_points: int, sizes: str) -> np.ndarray:
    """`point_index` of a target whose points belong to no tag; `sizes` are the fields to check in the rig file."""
    tag_id, corner = np.asarray(tag_id, dtype=np.int64), np.asarray(corner, dtype=np.int64)
    if (tag_id != 0).any():
        raise RecordingError(
            f"tag {tag_id[tag_id != 0][0]} is not on the target, whose corners have tag 0; correct the tag."
        )
    bad = (corner < 0) | (corner >= n_points)
    if bad.any():
        raise RecordingError(
            f"corner {corner[bad][0]} is not on the target (corners 0 to {n_points - 1}); "
            f"check {sizes} in the rig file."
        )
    return corner
