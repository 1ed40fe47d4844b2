"""A single tag, on a wall or on a robot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from icalib.errors import RecordingError
from icalib.geometry.targets.aprilgrid import UNIT_TAG
from icalib.geometry.targets.base import Target
from icalib.geometry.targets.families import checked_family


@dataclass(frozen=True)
class Tag(Target):
    """Tag `id` of `family` (any name that `family_name` accepts). size: edge of the black border [m].

    Corners are numbered as on an AprilGrid: 0 at the bottom left, then counterclockwise. Raises RigError if there is no
    such tag.
    """

    type: ClassVar[str] = "tag"
    blooms: ClassVar[bool] = True

    family: str
    id: int
    size: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "family", checked_family(self.family, self.id + 1))

    @cached_property
    def points(self) -> np.ndarray:
        """(4, 3) corners [m]."""
        return np.concatenate([self.size * UNIT_TAG, np.zeros((4, 1))], axis=1)

    @cached_property
    def tag_centers(self) -> np.ndarray:
        return np.tile([0.5 * self.size, 0.5 * self.size, 0.0], (4, 1))

    @cached_property
    def tag_number(self) -> np.ndarray:
        return np.arange(len(self.points)) // 4

    def point_index(self, tag_id: np.ndarray, corner: np.ndarray) -> np.ndarray:
        tag_id, corner = np.asarray(tag_id, dtype=np.int64), np.asarray(corner, dtype=np.int64)
        if (tag_id != self.id).any():
            raise RecordingError(f"tag {tag_id[tag_id != self.id][0]} is not tag {self.id}; leave it out.")
        if ((corner < 0) | (corner > 3)).any():
            raise RecordingError(
                f"corner {corner[(corner < 0) | (corner > 3)][0]} is not one of a tag's corners 0 to 3."
            )
        return corner

    def point_identity(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full_like(index, self.id), index
