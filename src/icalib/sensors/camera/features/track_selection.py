"""Noise and outliers of feature tracks, from the residuals of a pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.motion.factor import output_at
from icalib.motion.time_offsets import instants
from icalib.optim.arrowhead import chain_cuts
from icalib.optim.medians import grouped_quantiles, largest_normal, median_variance
from icalib.optim.state import State
from icalib.rig import Camera, Settings
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.features.residual import FeatureFactor
from icalib.sensors.camera.features.statistics import FeatureOutput
from icalib.sensors.camera.features.tracks import TrackNoise
from icalib.sensors.camera.image_times import are_used

FIRST_GUESS_PX = 1.0
SMALLEST_PX = 0.005
# So many of an image's observations are no outliers. At first a lens that is not found yet leaves large errors at the
# edges, which are none either.
GOOD_AT_FIRST, GOOD = 0.9, 0.5
FEWEST_IN_GROUP = 50  # observations, for their median variance to be known to a fifth


@dataclass(frozen=True)
class TrackSelection:
    """The feature tracks of one camera: their noise; keep (N,) bool, observations in use; outliers (N,) bool, those not
    in use because their residuals are large."""

    noise: TrackNoise
    keep: np.ndarray
    outliers: np.ndarray

    @classmethod
    def first(cls, camera: Camera, stream: TrackStream) -> TrackSelection:
        """Before any pass: stated noise, or a pixel, and all observations."""
        none = np.zeros(len(stream.uv), dtype=bool)
        return cls(TrackNoise(camera.track_noise_px or FIRST_GUESS_PX), ~none, none)


def next_selections(
    cameras: Sequence[Camera],
    factor: FeatureFactor,
    out: FeatureOutput,
    now: Sequence[TrackSelection],
    state: State,
    settings: Settings,
    is_first: bool,
) -> list[TrackSelection]:
    """By camera, for the next pass: noise as the residuals `out` at `state` show it, unless it is stated, and all
    observations but the outliers after the first pass (`is_first`) or a later one."""
    noise = tuple(_noise(c, factor, out, i) for i, c in enumerate(cameras))
    if settings.outlier_std <= 0.0:
        return [replace(own, noise=n) for own, n in zip(now, noise, strict=True)]
    # All that was seen, with the poses of the pass's end: those of its beginning left tracks out that these find, and
    # what a lens that was not found yet made an outlier may be none.
    shown = observed_at_keyframes(factor.cameras, factor.streams, state, settings.max_gap_s)
    anew = replace(factor, noise=noise, keep=shown).cut(state, chain_cuts(factor.n_keyframes))
    left, share = output_at(anew, state), GOOD_AT_FIRST if is_first else GOOD
    # The next pass uses no observation that was not judged, as those of tracks that the poses do not find.
    return [TrackSelection(n, *_judged(anew, left, i, settings, share)) for i, n in enumerate(noise)]


def observed_at_keyframes(
    cameras: Sequence[CornerFactor], streams: Sequence[TrackStream], state: State, max_gap_s: float
) -> tuple[np.ndarray, ...]:
    """By camera (N,) bool: observations of tracks in images that take part, see `are_used`."""
    used = (are_used(c.imu, instants(c.stream, state.values), state.seconds[c.keyframe], max_gap_s) for c in cameras)
    return tuple(np.repeat(u, np.diff(stream.start)) for u, stream in zip(used, streams, strict=True))


def _noise(camera: Camera, factor: FeatureFactor, out: FeatureOutput, index: int) -> TrackNoise:
    """As the rig file has it, or as medians show it, so that outliers have no say; each point takes three of its
    observations' rows."""
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
    return TrackNoise(max(sigma, SMALLEST_PX), growth)


def variance_growth(square: np.ndarray, views: np.ndarray) -> float:
    """By how much the variance of observations grows with each view, over that of a first view.

    square (n,) px^2: squared residuals; views (n,). A line through the median variances of groups of views, each with
    its number of observations as weight; 0 where they do not grow.
    """
    group = np.floor(np.log2(views + 1.0)).astype(int)
    rows = []
    for k in np.unique(group):
        own = group == k
        if own.sum() >= FEWEST_IN_GROUP:
            rows.append((float(views[own].mean()), median_variance(square[own]), float(own.sum())))
    if len(rows) < 2:
        return 0.0
    v, variance, count = np.array(rows).T
    slope, first = np.polyfit(v, variance, 1, w=np.sqrt(count) / variance)
    return float(max(slope, 0.0) / max(first, 0.1 * variance.min()))


def _judged(
    factor: FeatureFactor, out: FeatureOutput, index: int, settings: Settings, share: float
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool: observations of tracks in use that are no outliers and that the model can see; and those that are
    outliers, or that it cannot see.

    An outlier is `outlier_std` standard deviations above the mean of its image, and above `outlier_min_px`. Both are
    those of normal errors as large as that `share` of the image's: where few points are followed, one outlier alone
    would make mean and standard deviation so large that it is none.
    """
    stream = factor.streams[index]
    used, followed = out.root[index] > 0.0, factor.tracks.track[index] >= 0
    size, image = np.linalg.norm(out.residual[index], axis=1), stream.image
    relative = factor.sigmas[index] / factor.noise[index].sigma
    most = grouped_quantiles((size / relative)[used], image[used], len(stream.stamps_ns), share)
    limit = largest_normal(settings.outlier_std, share) * most[image] * relative
    good = followed & used & (size <= np.maximum(limit, settings.outlier_min_px))
    return good, followed & ~good
