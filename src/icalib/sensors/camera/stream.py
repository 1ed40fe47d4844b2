"""What a camera saw: corners of the target, and feature tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from icalib.sensors.stream import Stream, check, check_groups, which_image

EDGE = 7  # numbers that say how an edge was fitted: see `CornerStream`
NO_EDGES = np.zeros((0, 2, EDGE), dtype=np.float32)
NO_VIEWS = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class _ImageStream(Stream):
    """Rows of image i are start[i]:start[i + 1]."""

    sensor_type: ClassVar[str] = "camera"
    start: np.ndarray

    @property
    def image(self) -> np.ndarray:
        """(N,) the image that each row belongs to."""
        return np.repeat(np.arange(len(self.stamps_ns)), np.diff(self.start))


@dataclass(frozen=True)
class CornerStream(_ImageStream):
    """Target corners that one camera saw, image by image.

    stamps_ns (M,) int64, one per image, strictly increasing; start (M + 1,) int64, corners of image i are
    start[i]:start[i+1]; point (N,) int64, index into the target's points; uv (N, 2) pixels, (0, 0) is the
    centre of the top-left pixel; sigma (N,) pixels, the detector's standard deviation of each corner per axis up to a
    factor common to all, (0,) where it states none.

    edges (N, 2, EDGE) float32, (0, 2, EDGE) where it states none: the two edges that meet in each corner, as they were
    fitted. Columns: the piece of the edge that was used, from (2,) and to (2,) px beside the corner; gain (2,) px^2, by
    how much the corner moves where the piece's curvature is larger than the fitted one; that curvature [1 / px]. The
    curvature is positive where the piece, as u is to the right and v down, turns to the left on its way.

    files: names of the files that images come from, by stamp, "" for those of no file; also of images without corners.
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
        """The corners of `rows` (indices or a mask), grouped into images at stamps_ns (M,) with count (M,) each."""
        start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        sigma, edges = (x[rows] if len(x) else x for x in (self.sigma, self.edges))
        point, uv, files = self.point[rows], self.uv[rows], self.files
        return CornerStream(self.name, stamps_ns, start, point, uv, sigma=sigma, edges=edges, files=files)

    @classmethod
    def joined(cls, streams: Sequence[Any], shifts_ns: Sequence[int] | None = None) -> Self:
        parts = zip(streams, shifts_ns or [0] * len(streams), strict=True)
        files = {stamp + shift: file for stream, shift in parts for stamp, file in stream.files.items()}
        return replace(super().joined(streams, shifts_ns), files=files)

    def which(self, stamp_ns: int) -> str:
        """Tells the image with this stamp from others, in sentences."""
        return which_image(self.files.get(stamp_ns, ""), stamp_ns)

    @property
    def relative_sigma(self) -> np.ndarray:
        """(N,) each corner's standard deviation over that of the median corner; ones where the detector states none."""
        return self.sigma / np.median(self.sigma) if len(self.sigma) else np.ones(len(self.uv))


@dataclass(frozen=True)
class TrackStream(_ImageStream):
    """Points of the scene that one camera followed, image by image, as a front end reports them.

    stamps_ns (M,) int64, one per image, strictly increasing; start (M + 1,) int64, observations of image i are
    start[i]:start[i+1]; feature (N,) int64, the same number is the same point of the scene, in all cameras; uv (N, 2)
    pixels, (0, 0) is the centre of the top-left pixel; views (N,) int64, how many images the tracker had seen the
    feature in before, (0,) where it does not say; spread (N,) px^2, second moment of the patch that was aligned, along
    each axis, as the alignment weighs its points, (0,) where it does not say.
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
        """A camera may have corners as well."""
        return f"{self.name}/tracks"

    @classmethod
    def disjoint(cls, recordings: Sequence[Sequence[Any]]) -> Sequence[Sequence[Self]]:
        """Features numbered anew, so that no two recordings share one; cameras of one recording still do."""
        numbered, first = [], 0
        for streams in recordings:
            least = min((int(t.feature.min(initial=0)) for t in streams), default=0)
            most = max((int(t.feature.max(initial=-1)) for t in streams), default=-1)
            numbered.append([replace(t, feature=t.feature - least + first) for t in streams])
            first += 1 + most - least
        return numbered

    def which(self, stamp_ns: int) -> str:
        """Tells the image with this stamp from others, in sentences."""
        return which_image("", stamp_ns)


def shared_rows(start: np.ndarray, feature: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the features that images i and j share, as i and as j saw them; start (M + 1,), feature (N,) as in
    `TrackStream`."""
    own, other = feature[start[i] : start[i + 1]], feature[start[j] : start[j + 1]]
    _, p, q = np.intersect1d(own, other, return_indices=True)
    return p + start[i], q + start[j]
