"""A single tag, on a wall or on a robot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from icalib.errors import RecordingError
from icalib.geometry.targets.base import UNIT_TAG, TagTarget
from icalib.geometry.targets.families import checked_family


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
