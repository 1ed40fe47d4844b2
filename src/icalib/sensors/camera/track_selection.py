"""Noise and outliers of feature tracks, estimated from the residuals of a pass."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.model.sensor_model import Clusters, PassEnd
from icalib.motion.factor import FactorKey, output_at
from icalib.motion.poses import instants
from icalib.optim.arrowhead import chain_cuts
from icalib.optim.rows import grouped_quantiles, largest_normal, median_variance
from icalib.optim.state import State
from icalib.rig import Camera, Settings
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.image_times import are_used
from icalib.sensors.camera.track_factor import FeatureFactor
from icalib.sensors.camera.tracks import FeatureOutput, TrackNoise

INITIAL_TRACK_NOISE_PX = 1.0  # per axis, in the first pass
MIN_TRACK_NOISE_PX = 0.005  # per axis: no tracker is better; keeps weights finite
# Quantile of the residuals of an image, from which the limit for outliers is scaled. In the first pass a rough lens
# leaves large residuals at the border, which are no outliers, so the quantile is higher.
INLIER_SHARE_FIRST, INLIER_SHARE = 0.9, 0.5
MIN_GROUP_OBSERVATIONS = 50  # with these the median variance has a relative error of a fifth


@dataclass(frozen=True)
class TrackSelection:
    """Noise and inliers of the feature tracks of one camera.

    keep (N,) bool: observations in use; outliers (N,) bool: observations rejected because of large residuals."""

    noise: TrackNoise
    keep: np.ndarray
    outliers: np.ndarray

    @classmethod
    def first(cls, camera: Camera, stream: TrackStream) -> TrackSelection:
        """The selection of the first pass: noise of the rig file or one pixel, and all observations in use."""
        none = np.zeros(len(stream.uv), dtype=bool)
        return cls(TrackNoise(camera.track_noise_px or INITIAL_TRACK_NOISE_PX), ~none, none)


def next_selections(
    cameras: Sequence[Camera], factor: FeatureFactor, out: FeatureOutput, now: Sequence[TrackSelection], end: PassEnd
) -> list[TrackSelection]:
    """For each camera the selection of the next pass: noise by the residuals `out`, unless stated, and inliers.

    now: selections of this pass, which ends with `end`. The first pass has a laxer test."""
    settings, state = end.rig.settings, end.state
    noise = tuple(_noise(c, factor, out, i) for i, c in enumerate(cameras))
    if settings.outlier_std <= 0.0:
        return [replace(selection, noise=n) for selection, n in zip(now, noise, strict=True)]
    # All observations are tested again with the final poses of the pass. Its first poses may have left out good tracks,
    # and its first lens may have turned inliers into outliers.
    observed = observed_at_keyframes(factor.cameras, factor.streams, state, settings.max_gap_s)
    anew = replace(factor, noise=noise, keep=observed).cut(state, chain_cuts(factor.n_keyframes))
    left, share = output_at(anew, state), INLIER_SHARE_FIRST if end.is_first else INLIER_SHARE
    # Observations of tracks that are left out are not in use: their residuals are unknown.
    return [TrackSelection(n, *_tested(anew, left, i, settings, share)) for i, n in enumerate(noise)]


def observed_at_keyframes(
    cameras: Sequence[CornerFactor], streams: Sequence[TrackStream], state: State, max_gap_s: float
) -> tuple[np.ndarray, ...]:
    """For each camera (N,) bool: track observations in images that are in use, see `are_used`."""
    used = (are_used(c.imu, instants(c.stream, state.values), state.seconds[c.keyframe], max_gap_s) for c in cameras)
    return tuple(np.repeat(u, np.diff(stream.start)) for u, stream in zip(used, streams, strict=True))


def _noise(camera: Camera, factor: FeatureFactor, out: FeatureOutput, index: int) -> TrackNoise:
    """Noise of the tracks of camera number `index`: stated, or else by the median of squared residuals.

    The median is robust to outliers. It is corrected for three degrees of freedom per point."""
    used = [root > 0.0 for root in out.root]
    if camera.track_noise_px is not None:
        return TrackNoise(camera.track_noise_px)
    if not used[index].any():
        return factor.noise[index]
    square = (out.residual[index][used[index]] ** 2).sum(axis=1)
    views = factor.streams[index].views
    growth = variance_growth(square, views[used[index]]) if len(views) else 0.0
    if growth > 0.0:
        square = square / (1.0 + growth * views[used[index]])
    rows, points = 2 * sum(int(u.sum()) for u in used), factor.tracks.count
    sigma = float(np.sqrt(median_variance(square) / max(1.0 - 3.0 * points / rows, 0.1)))
    return TrackNoise(max(sigma, MIN_TRACK_NOISE_PX), growth)


def variance_growth(square: np.ndarray, views: np.ndarray) -> float:
    """Increase of the variance of observations per view, relative to the variance of the first view; 0 if none.

    square (n,) px^2: squared residuals; views (n,): number of earlier views of the feature. A line is fitted to the
    median variances of groups of similar numbers of views, with weights by numbers of observations.
    """
    group = np.floor(np.log2(views + 1.0)).astype(int)
    rows = []
    for k in np.unique(group):
        in_group = group == k
        if in_group.sum() >= MIN_GROUP_OBSERVATIONS:
            rows.append((float(views[in_group].mean()), median_variance(square[in_group]), float(in_group.sum())))
    if len(rows) < 2:
        return 0.0
    v, variance, count = np.array(rows).T
    slope, first = np.polyfit(v, variance, 1, w=np.sqrt(count) / variance)
    return float(max(slope, 0.0) / max(first, 0.1 * variance.min()))


def _tested(
    factor: FeatureFactor, out: FeatureOutput, index: int, settings: Settings, share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Inliers (N,) bool and outliers (N,) bool among the observations in tracks of camera number `index`.

    An outlier has a residual more than `outlier_std` standard deviations above the mean of its image, and above
    `outlier_min_px`; or the camera model does not project its point. Mean and standard deviation are those of normal
    errors with the image's quantile `share`, because sample moments of few points are not robust to an outlier.
    """
    stream = factor.streams[index]
    used, in_track = out.root[index] > 0.0, factor.tracks.track[index] >= 0
    size, image = np.linalg.norm(out.residual[index], axis=1), stream.image
    relative = factor.sigmas[index] / factor.noise[index].sigma
    most = grouped_quantiles((size / relative)[used], image[used], len(stream.stamps_ns), share)
    limit = largest_normal(settings.outlier_std, share) * most[image] * relative
    inlier = in_track & used & (size <= np.maximum(limit, settings.outlier_min_px))
    return inlier, in_track & ~inlier


# Clusters of corners and of track observations whose errors may correlate: by image cell, target region, or track.
#
# Misfit of the lens model, and deviations of the target from its stated shape, cause the same errors throughout a
# recording. So each region of the image or of the target is a cluster. Errors within a feature track correlate as
# well, because all its views are aligned with the first one. So groups of whole tracks are clusters, too. Clusters
# serve a cluster-robust covariance (Liang and Zeger 1986).

IMAGE_CELLS = (4, 3)  # columns and rows of the grid of image cells
TARGET_REGIONS = 3  # number of regions along each side of a body
TRACK_GROUPS = 24  # a variance from n groups has a relative error of sqrt(2 / n); the cost grows with n


def error_clusters(cameras: tuple[CornerFactor, ...], features: tuple[FeatureFactor, ...]) -> Iterator[Clusters]:
    """Yields clusterings by image cell, by target region, by corner of a tag, and by group of feature tracks.

    Clusterings of corners are left out if no camera sees a target, that of tracks if there are none."""
    cornered = any(c.sees_target for c in cameras)
    if cornered or features:
        yield Clusters(image_cells(cameras, features))
    if cornered:
        yield Clusters({c.key: _target_regions(c) for c in cameras})
        yield Clusters({c.key: _tag_corners(c, k) for k, c in enumerate(cameras)})
    if features:
        # Groups by feature number have all views of a feature, by all cameras. Corners are in no group.
        groups = {f.key: [(s.feature % TRACK_GROUPS).astype(np.int32) for s in f.streams] for f in features}
        yield Clusters(groups, is_sample=True)


def image_cells(
    cameras: tuple[CornerFactor, ...], features: tuple[FeatureFactor, ...]
) -> dict[FactorKey, np.ndarray | list[np.ndarray]]:
    """Image cell of each corner, and of each track observation by camera; both share the cells of their camera."""
    clusters: dict[FactorKey, np.ndarray | list[np.ndarray]] = {}
    tracks: dict[FactorKey, list[np.ndarray]] = {f.key: [] for f in features}
    for index, camera in enumerate(cameras):
        n = len(camera.stream.uv)
        cells = _cells(np.concatenate([camera.stream.uv, *(f.streams[index].uv for f in features)]), index)
        clusters[camera.key] = cells[:n]
        for f in features:
            tracks[f.key].append(cells[n:])
    return tracks | clusters


def _cells(uv: np.ndarray, index: int) -> np.ndarray:
    """(N,) index of the cell of each point uv (N, 2) px of camera `index`, in a grid over the bounding box of uv.

    Cells of different cameras have different indices."""
    columns, rows = IMAGE_CELLS
    low, high = uv.min(axis=0, initial=np.inf), uv.max(axis=0, initial=-np.inf) + 1e-9
    x, y = (((uv[:, k] - low[k]) / (high - low)[k] * IMAGE_CELLS[k]).astype(np.int32) for k in range(2))
    return (index * rows + y) * columns + x


def _target_regions(camera: CornerFactor) -> np.ndarray:
    """(N,) index of the target region of each corner, the same for all cameras.

    Bodies that do not bend, such as single tags, are one region."""
    target = camera.bodies.target
    region, count = np.zeros(len(target.points), dtype=np.int32), 0
    for k in camera.bodies.used:
        points = target.body == k
        xy = target.points[points, :2]
        low, high = xy.min(axis=0), xy.max(axis=0) + 1e-9
        sides = TARGET_REGIONS if target.bends[k] else 1
        cell = ((xy - low) / (high - low) * sides).astype(int)
        region[points] = count + cell[:, 1] * sides + cell[:, 0]
        count += sides**2
    return region[camera.stream.point]


def _tag_corners(camera: CornerFactor, index: int) -> np.ndarray:
    """(N,) index of each corner among the four of its tag, plus 4 `index` for camera `index`.

    Systematic errors of detectors differ between the four corners."""
    corner = camera.bodies.target.point_identity(camera.stream.point)[1]
    return 4 * index + (corner % 4).astype(np.int32)
