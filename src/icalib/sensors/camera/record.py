"""Residuals of images, as a result stores them: target corners, and observations of tracked scene points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from icalib.sensors.records import Shapes, Successive

_IMAGES: Shapes = {
    "seconds": ("f", "images"),
    "start": ("iu", "edges"),
    "point": ("iu", "n"),
    "uv": ("f", "n", 2),
    "residual": ("f", "n", 2),
    "sigma": ("f", "n"),
    "rejected": ("b", "n"),
}


class _PointsInImages:
    """Base class of both records: residuals of N points, image by image."""

    kind: str
    start: np.ndarray
    point: np.ndarray
    residual: np.ndarray
    sigma: np.ndarray

    @property
    def used(self) -> np.ndarray:
        """(N,) bool: residuals in use."""
        raise NotImplementedError

    @property
    def whitened(self) -> np.ndarray:
        """(N, 2) residuals over their standard deviations; NaN for observations without a residual."""
        return self.residual / self.sigma[:, None]

    def normalised(self) -> dict[str, np.ndarray]:
        """Whitened residuals in use, u and v in one array, keyed by the title of their plot."""
        return {f"{self.kind} (u and v)": self.whitened[self.used].ravel()}

    def successive(self) -> dict[str, Successive]:
        """Whitened residuals in use by kind, ordered by point and image, with a flag for each successive pair.

        The flag tells whether both residuals are of one point in two consecutive images."""
        image, point = image_of(self), self.point
        order = np.lexsort((image, point))
        order = order[self.used[order]]
        follows = (np.diff(point[order]) == 0) & (np.diff(image[order]) == 1)
        return {self.kind: Successive(self.whitened[order].astype(np.float64), follows)}


@dataclass(frozen=True)
class CornerResiduals(_PointsInImages):
    """Residuals (predicted - measured) of one camera's corners, in recorded order, rejected corners included."""

    kind: str = field(default="corners", init=False)
    shapes: ClassVar[Shapes] = _IMAGES

    sensor: str
    seconds: np.ndarray  # (M,) image times, imu clock, s since the first IMU stamp; see RecordingSpan for several
    start: np.ndarray  # (M + 1,) corners of image i are start[i]:start[i+1]
    point: np.ndarray  # (N,) index into the target's points
    uv: np.ndarray  # (N, 2) measured, px; corrected for edge curvature by the estimate where icalib detected them
    residual: np.ndarray  # (N, 2) px
    sigma: np.ndarray  # (N,) px, standard deviation per axis assumed by the estimate
    rejected: np.ndarray  # (N,) bool

    @property
    def used(self) -> np.ndarray:
        """(N,) bool: residuals in use."""
        return ~self.rejected


@dataclass(frozen=True)
class TrackResiduals(_PointsInImages):
    """Residuals (predicted - measured) of tracked points in the images of one camera, in recorded order.

    Each point is at its least-squares position. The residual is NaN if the observation is not used: it is rejected, or
    its track is too short, its point uncertain, or its fit far worse than most. distance: median distance [m] of the
    points from the camera; None without points.
    """

    kind: str = field(default="observations", init=False)
    shapes: ClassVar[Shapes] = _IMAGES

    sensor: str
    distance: float | None
    seconds: np.ndarray  # (M,) image times, imu clock, s since the first IMU stamp; see RecordingSpan for several
    start: np.ndarray  # (M + 1,) observations of image i are start[i]:start[i+1]
    point: np.ndarray  # (N,) number of the point of the scene, the same in all cameras
    uv: np.ndarray  # (N, 2) measured, px
    residual: np.ndarray  # (N, 2) float32 px
    sigma: np.ndarray  # (N,) px, standard deviation per axis assumed by the estimate
    rejected: np.ndarray  # (N,) bool

    @property
    def used(self) -> np.ndarray:
        """(N,) bool: residuals in use."""
        return np.isfinite(self.residual[:, 0])


RECORDS = (CornerResiduals, TrackResiduals)
ImageResiduals = CornerResiduals | TrackResiduals


def image_of(r: _PointsInImages) -> np.ndarray:
    """(N,) index of the image of each residual."""
    return np.repeat(np.arange(len(r.start) - 1), np.diff(r.start))


def rms_of_images(r: ImageResiduals) -> np.ndarray:
    """(M,) px: RMS per coordinate of each image, NaN if it has no residuals in use."""
    image, square = image_of(r)[r.used], (r.residual[r.used].astype(np.float64) ** 2).sum(axis=1)
    count = np.bincount(image, minlength=len(r.seconds))
    return np.sqrt(np.bincount(image, square, len(r.seconds)) / np.where(count > 0, 2.0 * count, np.nan))
