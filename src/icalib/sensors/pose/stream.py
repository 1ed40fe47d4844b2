"""Measurements of a pose sensor."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from icalib.sensors.stream import Stream, check, far_origin


@dataclass(frozen=True)
class PoseStream(Stream):
    """Measured poses of a sensor, in a frame that is static or drifts slowly.

    stamps_ns (N,) int64: strictly increasing; rotation (N, 3, 3): R_frame_sensor; position (N, 3): p_frame_sensor [m].
    numbers (N, 3, 4 or 9): the rotations as a table wrote them, or (0, 0).
    """

    sensor_type: ClassVar[str] = "pose"
    rotation: np.ndarray
    position: np.ndarray
    numbers: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        super().__post_init__()
        n = len(self.stamps_ns)
        shape = self.rotation.shape
        check(shape == (n, 3, 3), f"{self.name}: rotation must have shape ({n}, 3, 3), not {shape}.")
        shape = self.position.shape
        check(shape == (n, 3), f"{self.name}: position must have shape ({n}, 3), not {shape}.")

    def better_origin(self) -> np.ndarray | None:
        return far_origin(self.position)

    def relative_to(self, origin: np.ndarray) -> PoseStream:
        return replace(self, position=self.position - origin)
