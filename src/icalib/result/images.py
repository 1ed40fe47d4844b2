"""What is left of what cameras saw: corners of a target, and points of the scene that they followed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np


@dataclass(frozen=True)
class CornerResiduals:
    """Residuals (predicted - measured) of one camera's corners, in the recording's order; rejected ones stay."""

    kind: ClassVar[str] = "corners"

    sensor: str
    seconds: np.ndarray  # (M,) image times, imu clock, s since the first IMU stamp; see RecordingSpan for several
    start: np.ndarray  # (M + 1,) corners of image i are start[i]:start[i+1]
    point: np.ndarray  # (N,) index into the target's points
    uv: np.ndarray  # (N, 2) measured, px; on edges as bent as the estimate says, where icalib found them in images
    residual: np.ndarray  # (N, 2) px
    sigma: np.ndarray  # (N,) px, standard deviation that the corner was given
    rejected: np.ndarray  # (N,) bool

    @property
    def used(self) -> np.ndarray:
        """(N,) bool"""
        return ~self.rejected

    @property
    def whitened(self) -> np.ndarray:
        """(N, 2) residuals over their standard deviation."""
        return self.residual / self.sigma[:, None]


@dataclass(frozen=True)
class TrackResiduals:
    """Residuals (predicted - measured) of the points of the scene that one camera followed, in the recording's order,
    each point being where all its images want it. What is not in use has none, NaN: observations that were rejected,
    and tracks that are too short, whose point is uncertain, or that fit far worse than most.

    distance: m, median of the points in use from the camera; None where there are none.
    """

    kind: ClassVar[str] = "observations"

    sensor: str
    distance: float | None
    seconds: np.ndarray  # (M,) image times, imu clock, s since the first IMU stamp; see RecordingSpan for several
    start: np.ndarray  # (M + 1,) observations of image i are start[i]:start[i+1]
    point: np.ndarray  # (N,) number of the point of the scene, the same in all cameras
    uv: np.ndarray  # (N, 2) measured, px
    residual: np.ndarray  # (N, 2) float32 px
    sigma: np.ndarray  # (N,) px, standard deviation that the observation was given
    rejected: np.ndarray  # (N,) bool

    @property
    def used(self) -> np.ndarray:
        """(N,) bool"""
        return np.isfinite(self.residual[:, 0])

    @property
    def whitened(self) -> np.ndarray:
        """(N, 2) residuals over their standard deviation, NaN where there are none."""
        return self.residual / self.sigma[:, None]


ImageResiduals = CornerResiduals | TrackResiduals


def image_of(r: ImageResiduals) -> np.ndarray:
    """(N,) the image that each was seen in."""
    return np.repeat(np.arange(len(r.seconds)), np.diff(r.start))


def rms_of_images(r: ImageResiduals) -> np.ndarray:
    """(M,) RMS [px] per coordinate of each image, NaN where nothing was used."""
    image, square = image_of(r)[r.used], (r.residual[r.used].astype(np.float64) ** 2).sum(axis=1)
    count = np.bincount(image, minlength=len(r.seconds))
    return np.sqrt(np.bincount(image, square, len(r.seconds)) / np.where(count > 0, 2.0 * count, np.nan))
