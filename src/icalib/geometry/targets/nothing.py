"""No target: cameras use feature tracks of the scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, final

import numpy as np

from icalib.errors import RecordingError
from icalib.geometry.targets.base import Target


@final
@dataclass(frozen=True)
class NoTarget(Target):
    """A target without points, for rigs without a target."""

    type: ClassVar[str] = "none"
    blooms: ClassVar[bool] = False

    @cached_property
    def points(self) -> np.ndarray:
        return np.zeros((0, 3))

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        return ()

    def point_index(self, tag_id: np.ndarray, corner: np.ndarray) -> np.ndarray:
        del tag_id, corner
        raise RecordingError("the rig file has no target; add one.")

    def point_identity(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return index, index
