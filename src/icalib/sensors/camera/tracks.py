"""Factor of feature tracks of all cameras, with points that may lie on planes of LiDARs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.motion.factor import FitKey, RawSize, ResidualRows, Squares, StateDifference, output_at
from icalib.optim.state import State
from icalib.sensors.camera.corner_factor import image_rows, rms_px
from icalib.sensors.camera.track_surfaces import ON_PLANES, PlaneDistances

if TYPE_CHECKING:
    from icalib.sensors.camera.track_factor import FeatureFactor


# Tracks: splits features into the tracks that the estimate uses.
#
# A feature becomes one or several tracks. Tracks end where the chain of keyframes is cut, between recordings, and
# where the feature is unobserved for long, because the cost of elimination grows with the length of tracks. Each track
# is estimated as a separate point. Only the constraint that tracks of one feature are the same point is lost.

MIN_TRACK_OBSERVATIONS = 3  # two observations hardly constrain the poses


@dataclass(frozen=True)
class TrackNoise:
    """Noise of the tracks of one camera: sigma_n^2 = sigma^2 (1 + growth n), with n earlier views of the feature.

    sigma [px]: standard deviation per axis of the first view; growth: relative increase of the variance per view."""

    sigma: float
    growth: float = 0.0

    def of(self, stream: TrackStream) -> np.ndarray:
        """(N,) px: standard deviation of each observation per axis; `sigma` for all if numbers of views are unknown."""
        if not len(stream.views):
            return np.full(len(stream.uv), self.sigma)
        return self.sigma * np.sqrt(1.0 + self.growth * stream.views)


@dataclass(frozen=True)
class Tracks:
    """Tracks in the order of their first keyframes.

    For each camera: track, pair (N,): index of the track and of the pair of each observation, -1 without a track. A
    pair is a track with one of its images: pair_track, pair_camera, pair_image (E,) are its indices, in the order of
    keyframes. edges (S + 1,): keyframes at which all tracks end; tracks_from, pairs_from (S + 1,): first track and pair
    after each edge. The anchor of a track is the image in the middle of its observations: camera, image (T,). start
    (T, 3) m: initial points, in the frames of the anchor cameras."""

    track: tuple[np.ndarray, ...]
    pair: tuple[np.ndarray, ...]
    pair_track: np.ndarray
    pair_camera: np.ndarray
    pair_image: np.ndarray
    edges: np.ndarray
    tracks_from: np.ndarray
    pairs_from: np.ndarray
    camera: np.ndarray
    image: np.ndarray
    start: np.ndarray

    @property
    def count(self) -> int:
        return len(self.start)

    def stretch_of(self) -> np.ndarray:
        """(T,) keyframe index of the last edge at or before the start of each track."""
        return self.edges[np.searchsorted(self.tracks_from, np.arange(self.count), side="right") - 1]

    def within(self, first: int, stop: int) -> tuple[slice, slice]:
        """Slices of the tracks and of the pairs between the keyframes `first` and `stop`, which must be edges."""
        a, b = np.searchsorted(self.edges, [first, stop])
        return slice(*self.tracks_from[[a, b]].tolist()), slice(*self.pairs_from[[a, b]].tolist())


@dataclass(frozen=True)
class ObservationTable:
    """All N observations of all cameras, camera by camera.

    feature, image, keyframe (N,): number of the feature, index of the image of its camera, index of the keyframe. used
    (N,) bool: whether the observation may be in a track; counts: number of observations of each camera."""

    feature: np.ndarray
    image: np.ndarray
    keyframe: np.ndarray
    used: np.ndarray
    counts: tuple[int, ...]

    def labels(self, seconds: np.ndarray, edges: np.ndarray, longest_gap: float) -> np.ndarray:
        """(N,) label of the track of each observation, -1 if not used.

        Tracks end at the keyframes `edges`, and where a feature is unobserved for longer than `longest_gap` [s].
        seconds (K,): times of the keyframes."""
        at = np.flatnonzero(self.used)
        order = at[np.lexsort((self.keyframe[at], self.feature[at]))]
        feature, keyframe = self.feature[order], self.keyframe[order]
        stretch = np.searchsorted(edges, keyframe, side="right")
        new = np.ones(len(order), dtype=bool)
        new[1:] = (np.diff(feature) != 0) | (np.diff(stretch) != 0) | (np.diff(seconds[keyframe]) > longest_gap)
        out = np.full(len(self.feature), -1)
        out[order] = np.cumsum(new) - 1
        return out

    def in_order(self, label: np.ndarray) -> np.ndarray:
        """The labels (N,), renumbered in the order of first keyframes; -1 for tracks with too few observations."""
        labelled = label >= 0
        n = int(label.max(initial=-1)) + 1
        first = np.full(n, np.iinfo(np.int64).max)
        np.minimum.at(first, label[labelled], self.keyframe[labelled])
        left = np.bincount(label[labelled], minlength=n) >= MIN_TRACK_OBSERVATIONS
        order = np.argsort(first, kind="stable")
        number = np.full(n + 1, -1)
        number[order[left[order]]] = np.arange(int(left.sum()))
        return number[label]

    def tracks(self, label: np.ndarray, edges: np.ndarray) -> Tracks:
        """The tracks of labels (N,) as `in_order` returns them, with all initial points at zero."""
        labelled, n = np.flatnonzero(label >= 0), int(label.max(initial=-1)) + 1
        pairs = labelled[np.argsort(self.keyframe[labelled], kind="stable")]
        pair = np.full(len(label), -1)
        pair[pairs] = np.arange(len(pairs))
        lives = pairs[np.argsort(label[pairs], kind="stable")]
        begins = np.searchsorted(label[lives], np.arange(n))
        middle = lives[begins + np.bincount(label[lives], minlength=n) // 2]
        tracks_from = np.searchsorted(self.keyframe[lives[begins]], edges)
        camera = np.repeat(np.arange(len(self.counts)), self.counts)
        track_by_camera, pair_by_camera = (tuple(np.split(a, np.cumsum(self.counts)[:-1])) for a in (label, pair))
        return Tracks(
            track_by_camera, pair_by_camera, label[pairs], camera[pairs], self.image[pairs], edges, tracks_from,
            np.searchsorted(self.keyframe[pairs], edges), camera[middle], self.image[middle], np.zeros((n, 3)),
        )  # fmt: skip


_NO_NUMBERS = np.zeros(0, dtype=np.int64)
_NO_EDGES = np.zeros(2, dtype=np.int64)
NO_TRACKS = Tracks(
    (),
    (),
    _NO_NUMBERS,
    _NO_NUMBERS,
    _NO_NUMBERS,
    _NO_EDGES,
    _NO_EDGES,
    _NO_EDGES,
    _NO_NUMBERS,
    _NO_NUMBERS,
    np.zeros((0, 3)),
)


# Residual statistics of feature tracks, and the degrees of freedom that the fit of points and parameters takes.

FEATURES = "features"  # kind of the residuals of tracks


@dataclass(frozen=True)
class FeatureOutput:
    """Residuals of all tracks.

    For each camera: residual (N, 2) px, predicted - measured; root (N,) 1/px, square root of the robust weight over
    sigma, 0 if not in use. points (T, 3) m, in the frames of their anchor cameras; off: their distances from planes."""

    residual: tuple[np.ndarray, ...]
    root: tuple[np.ndarray, ...]
    points: np.ndarray
    off: PlaneDistances


def feature_squares(factor: FeatureFactor, out: FeatureOutput) -> dict[FitKey, Squares]:
    """Number and chi^2 of the tracks of each camera, and of its points on planes if there are any."""
    squares, off = {}, out.off
    for i, (camera, residual, root) in enumerate(zip(factor.cameras, out.residual, out.root, strict=True)):
        chi2 = float(((residual * root[:, None]) ** 2).sum())
        squares[camera.name, FEATURES] = Squares(2 * int((root > 0.0).sum()), chi2)
        if len(on_planes := factor.on_planes_of(i)):
            chi2 = float(((off.residual * off.root)[on_planes] ** 2).sum())
            squares[camera.name, ON_PLANES] = Squares(len(on_planes), chi2)
    return squares


def feature_sizes(factor: FeatureFactor, out: FeatureOutput) -> dict[FitKey, RawSize]:
    """RMS of the tracks of each camera, and of its points on planes.

    Outliers count as rejected, but observations of tracks that are left out do not."""
    sizes = {}
    for i, camera in enumerate(factor.cameras):
        rejected = int(factor.outliers[i].sum()) if factor.outliers else 0
        sizes[camera.name, FEATURES] = RawSize(rms_px(out.residual[i], out.root[i]), "px", rejected)
        if len(on_planes := factor.on_planes_of(i)):
            sizes[camera.name, ON_PLANES] = RawSize(float(np.sqrt(np.mean(out.off.residual[on_planes] ** 2))), "m")
    return sizes


def feature_rows(factor: FeatureFactor, out: FeatureOutput, state: State) -> list[ResidualRows]:
    """Residuals of the tracks of each camera."""
    rows = []
    for camera, stream, sigma, residual, root in zip(
        factor.cameras, factor.streams, factor.sigmas, out.residual, out.root, strict=True
    ):
        seconds = camera.instants(state)[stream.image]
        rows.append(image_rows(camera.name, FEATURES, seconds, residual, sigma, root))
    return rows


def dof_used_by_features(factor: FeatureFactor, at: FeatureOutput, along: StateDifference) -> dict[FitKey, float]:
    """See `Factor.dof_used`: |J x|^2 of the tracks of each camera, with re-optimised points, plus the share of points.

    Each point takes three degrees of freedom: its plane's share from the plane residual, the rest from the cameras in
    proportion to their observations."""
    end, count = output_at(factor, along.end), np.zeros(factor.tracks.count)
    used = [root > 0.0 for root in at.root]
    for track, u in zip(factor.tracks.track, used, strict=True):
        count += np.bincount(track[u], minlength=len(count))
    spent = {}
    for i, camera in enumerate(factor.cameras):
        root, u = at.root[i], used[i]
        slope = (end.residual[i] - at.residual[i]) / along.share
        point_dof = float(((3.0 - at.off.share) / np.maximum(count, 1))[factor.tracks.track[i][u]].sum())
        spent[camera.name, FEATURES] = point_dof + float(((slope * root[:, None])[u] ** 2).sum())
        if len(on := factor.on_planes_of(i)):
            slope = (end.off.residual - at.off.residual)[on] / along.share * at.off.root[on]
            # A row takes 1 - E[chi^2]: w = weight / sigma^2, v is the point's variance along the normal by the cameras,
            # and s = w v / (1 + w v) the share. The fit of the point leaves E[chi^2] = w (1 - s)^2 (v + sigma^2).
            # weight < 1: all rows of one patch together have the weight of one row.
            left, weight = 1.0 - at.off.share[on], factor.on.weight[on]
            point_dof = float((1.0 - left * (left * weight + at.off.share[on])).sum())
            spent[camera.name, ON_PLANES] = point_dof + float((slope**2).sum())
    return spent
