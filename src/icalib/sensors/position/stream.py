"""Measurements of a position sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from icalib.sensors.stream import RowResiduals, Shapes, Stream, Successive, check


@dataclass(frozen=True)
class PositionStream(Stream):
    """Positions of one sensor in its static frame.

    stamps_ns (N,) int64, strictly increasing; position (N, 3) p_frame_sensor [m]; covariance (N, 3, 3) m^2 in the
    frame's axes as the recording states it, or (0, 3, 3) if it states none.
    """

    sensor_type: ClassVar[str] = "position"
    position: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        super().__post_init__()
        n = len(self.stamps_ns)
        check(self.position.shape == (n, 3), f"{self.name}: position must have shape ({n}, 3).")
        stated = self.covariance.shape in ((n, 3, 3), (0, 3, 3))
        check(stated, f"{self.name}: covariance must have shape ({n}, 3, 3), or (0, 3, 3) without any.")

    def some(self, kept: np.ndarray) -> PositionStream:
        """The stream with the fixes for which `kept` (N,) bool is True."""
        covariance = self.covariance[kept] if len(self.covariance) else self.covariance
        return replace(self, stamps_ns=self.stamps_ns[kept], position=self.position[kept], covariance=covariance)

    def relative_to(self, origin: np.ndarray) -> PositionStream:
        return replace(self, position=self.position - origin)

    @property
    def root(self) -> np.ndarray:
        """(N, 3, 3) W [1/m] with W^T W the inverse of the stated covariance; the identity if none is stated."""
        if not len(self.covariance):
            return np.tile(np.eye(3), (len(self.stamps_ns), 1, 1))
        return np.linalg.inv(np.linalg.cholesky(self.covariance))


@dataclass(frozen=True)
class PositionResiduals(RowResiduals):
    """Residuals of n fixes along the axes of their frame. position (n, 3) m: the fixes in it; rejected (n,) bool:
    outliers, without weight in the estimate."""

    shapes: ClassVar[Shapes] = RowResiduals.shapes | {"position": ("f", "n", 3), "rejected": ("b", "n")}

    position: np.ndarray
    rejected: np.ndarray

    def normalised(self) -> dict[str, np.ndarray]:
        return {label: self.whitened[~self.rejected, k] for k, label in enumerate(self.labels)}

    def successive(self) -> dict[str, Successive]:
        used = np.flatnonzero(~self.rejected)
        follows = np.diff(used) == 1
        return {label: Successive(self.whitened[used, k : k + 1], follows) for k, label in enumerate(self.labels)}
