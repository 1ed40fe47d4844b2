"""Separate tags of one family and size at unknown poses.

A single tag, on a wall or on a robot.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from icalib.errors import RecordingError, RigError
from icalib.geometry.targets.base import UNIT_TAG, TagTarget
from icalib.geometry.targets.families import FAMILIES, TagSet, checked_family


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
