"""Measurements of a camera: corners of the target, and feature tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from icalib.geometry.planes import EDGE, NO_EDGES
from icalib.sensors.stream import Shapes, Stream, Successive, check, check_groups, which_image

NO_VIEWS = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class _ImageStream(Stream):
    """Observations in M images. start (M + 1,): the rows of image i are start[i]:start[i + 1]. jitter_s: rough standard
    deviation of the stamps' errors, 0 if stamps are true."""

    sensor_type: ClassVar[str] = "camera"
    start: np.ndarray
    jitter_s: float = field(default=0.0, kw_only=True)

    @property
    def image(self) -> np.ndarray:
        """(N,) index of the image of each row."""
        return np.repeat(np.arange(len(self.stamps_ns)), np.diff(self.start))


@dataclass(frozen=True)
class CornerStream(_ImageStream):
    """Target corners that one camera saw, image by image.

    stamps_ns (M,) int64, one per image, strictly increasing; start (M + 1,) int64, corners of image i are
    start[i]:start[i+1]; point (N,) int64, index into the target's points; uv (N, 2) pixels, (0, 0) is the
    centre of the top-left pixel; sigma (N,) pixels, the detector's standard deviation of each corner per axis up to a
    factor common to all, (0,) if it states none.

    edges (N, 2, EDGE) float32: fits of the two edges that meet in each corner, with the columns of
    `geometry.edge_fits`; (0, 2, EDGE) if the detector states none.

    files: file name of each image by stamp, "" if it is from no file; images without corners may be included.
    """

    point: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray = field(default_factory=lambda: np.zeros(0), kw_only=True)
    edges: np.ndarray = field(default_factory=lambda: NO_EDGES, kw_only=True)
    files: Mapping[int, str] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        n, m = len(self.uv), len(self.stamps_ns)
        check(self.start.shape == (m + 1,), f"{self.name}: start must have shape ({m + 1},), not {self.start.shape}.")
        check(int(self.start[-1]) == n, f"{self.name}: start must end at the number of corners, {n}.")
        check(self.point.shape == (n,), f"{self.name}: point must have shape ({n},), not {self.point.shape}.")
        check(self.uv.shape == (n, 2), f"{self.name}: uv must have shape ({n}, 2), not {self.uv.shape}.")
        stated = self.sigma.shape in ((0,), (n,)) and bool((self.sigma > 0.0).all())
        check(stated, f"{self.name}: sigma must be positive, one for each of the {n} corners or none.")
        fits = self.edges.shape in (NO_EDGES.shape, (n, 2, EDGE))
        check(fits, f"{self.name}: edges must have shape ({n}, 2, {EDGE}), not {self.edges.shape}.")

    def of_rows(self, rows: np.ndarray, stamps_ns: np.ndarray, count: np.ndarray) -> CornerStream:
        """The corners `rows` (indices or mask), grouped into images at stamps_ns (M,) with count (M,) corners each."""
        start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        sigma, edges = (x[rows] if len(x) else x for x in (self.sigma, self.edges))
        point, uv, of_images = self.point[rows], self.uv[rows], {"files": self.files, "pictures": self.pictures}
        return CornerStream(
            self.name, stamps_ns, start, point, uv, sigma=sigma, edges=edges, jitter_s=self.jitter_s, **of_images
        )

    def by_point(self) -> np.ndarray:
        """(M, P, 2) float32: where each image shows each point, NaN where it does not."""
        uv = np.full((len(self.stamps_ns), int(self.point.max(initial=0)) + 1, 2), np.nan, np.float32)
        uv[self.image, self.point] = self.uv
        return uv

    @classmethod
    def joined(cls, streams: Sequence[Any], shifts_ns: Sequence[int] | None = None) -> Self:
        parts = zip(streams, shifts_ns or [0] * len(streams), strict=True)
        files = {stamp + shift: file for stream, shift in parts for stamp, file in stream.files.items()}
        jitter_s = max(stream.jitter_s for stream in streams)
        return replace(super().joined(streams, shifts_ns), files=files, jitter_s=jitter_s)

    def which(self, stamp_ns: int) -> str:
        """Text that names the image with this stamp in messages: its file, or else its stamp."""
        return which_image(self.files.get(stamp_ns, ""), stamp_ns)

    def nearest(self, second: float) -> str:
        """Text that names the image nearest to `second` after the first."""
        return self.which(int(self.stamps_ns[np.argmin(np.abs(self.seconds - second))]))

    @property
    def relative_sigma(self) -> np.ndarray:
        """(N,) detector's standard deviation of each corner, over that of the median corner; ones if it states none."""
        return self.sigma / np.median(self.sigma) if len(self.sigma) else np.ones(len(self.uv))


@dataclass(frozen=True)
class TrackStream(_ImageStream):
    """Feature tracks of one camera, image by image, as a front end reports them.

    stamps_ns (M,) int64, one per image, strictly increasing; start (M + 1,) int64, observations of image i are
    start[i]:start[i+1]; feature (N,) int64, number of the point of the scene, the same in all cameras; uv (N, 2)
    pixels, (0, 0) is the centre of the top-left pixel; views (N,) int64, number of earlier images with the feature,
    (0,) if unknown; spread (N,) px^2, second moment of the aligned patch along each axis, weighted as in the alignment,
    (0,) if unknown.
    """

    feature: np.ndarray
    uv: np.ndarray
    views: np.ndarray = field(default_factory=lambda: NO_VIEWS, kw_only=True)
    spread: np.ndarray = field(default_factory=lambda: np.zeros(0), kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = {"feature": len(self.feature), "uv": len(self.uv)}
        counts |= {name: n for name in ("views", "spread") if (n := len(getattr(self, name)))}
        check_groups(self.name, self.stamps_ns, self.start, "observations", counts)
        check(self.feature.dtype == np.int64, f"{self.name}: feature must be int64.")
        check(self.uv.shape[1:] == (2,), f"{self.name}: uv must have shape (N, 2), not {self.uv.shape}.")

    @property
    def key(self) -> str:
        """See `Stream`: the camera's name with a suffix, because the name alone is the key of its corners."""
        return f"{self.name}/tracks"

    @classmethod
    def disjoint(cls, recordings: Sequence[Sequence[Any]]) -> Sequence[Sequence[Self]]:
        """See `Stream`: renumbers features, so that recordings share none; cameras of one recording still do."""
        numbered, first = [], 0
        for streams in recordings:
            least = min((int(t.feature.min(initial=0)) for t in streams), default=0)
            most = max((int(t.feature.max(initial=-1)) for t in streams), default=-1)
            numbered.append([replace(t, feature=t.feature - least + first) for t in streams])
            first += 1 + most - least
        return numbered

    def which(self, stamp_ns: int) -> str:
        """Text that names the image with this stamp in messages: its stamp."""
        return which_image("", stamp_ns)


def shared_rows(start: np.ndarray, feature: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows (n,) of image i and rows (n,) of image j that observe the same features.

    start (M + 1,), feature (N,): see `TrackStream`."""
    features, other = feature[start[i] : start[i + 1]], feature[start[j] : start[j + 1]]
    _, p, q = np.intersect1d(features, other, return_indices=True)
    return p + start[i], q + start[j]


# Residuals of images, as a result stores them: target corners, and observations of tracked scene points.

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

    @property
    def rms_of_images(self) -> np.ndarray:
        """(M,) px: RMS per coordinate of each image, NaN if it has no residuals in use."""
        image, square = image_of(self)[self.used], (self.residual[self.used].astype(np.float64) ** 2).sum(axis=1)
        n_images = len(self.start) - 1
        count = np.bincount(image, minlength=n_images)
        return np.sqrt(np.bincount(image, square, n_images) / np.where(count > 0, 2.0 * count, np.nan))

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


ImageResiduals = CornerResiduals | TrackResiduals


def image_of(r: _PointsInImages) -> np.ndarray:
    """(N,) index of the image of each residual."""
    return np.repeat(np.arange(len(r.start) - 1), np.diff(r.start))
