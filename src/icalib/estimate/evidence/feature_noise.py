"""How large the errors of tracks are, and which observations stand out, judged from what a pass leaves behind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.estimate.problem.assembly import Following, on_the_chain
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.problem.outcome import Outcome
from icalib.motion.factor import look, pairs_of
from icalib.optim.arrowhead import chain_cuts
from icalib.optim.medians import grouped_quantiles, largest_normal, median_variance
from icalib.rig import Camera, Settings
from icalib.sensors.camera.features.feature_factor import FeatureFactor
from icalib.sensors.camera.features.feature_statistics import FeatureOutput
from icalib.sensors.camera.features.tracks import TrackNoise

FIRST_GUESS_PX = 1.0
SMALLEST_PX = 0.005
# So many of an image's observations are no outliers. At first a lens that is not found yet leaves large errors at the
# edges, which are none either.
GOOD_AT_FIRST, GOOD = 0.9, 0.5
FEWEST_IN_GROUP = 50  # observations, for their median variance to be known to a fifth


def first_following(inputs: Inputs) -> Following | None:
    """Before anything is known: what the rig file says, or a pixel; everything in use, tracks cut short, which costs
    little and leads near. None where there are no tracks."""
    if not inputs.measurements.tracks:
        return None
    noise = tuple(TrackNoise(c.track_noise_px or FIRST_GUESS_PX) for c in inputs.rig.cameras)
    none = tuple(np.zeros(len(t.uv), dtype=bool) for t in inputs.measurements.tracks)
    return Following(noise, tuple(~x for x in none), none, True)


def next_following(inputs: Inputs, outcome: Outcome, now: Following, first: bool) -> Following:
    """Of the next pass: noise as the residuals show it, where it is not given, and all observations but the outliers
    that stand out after the `first` pass or another."""
    rig, ((factor, out),) = inputs.rig, pairs_of(outcome.problem.factors, outcome.residuals, FeatureFactor)
    noise = tuple(_noise(c, factor, out, i) for i, c in enumerate(rig.cameras))
    if rig.settings.outlier_std <= 0.0:
        return Following(noise, now.keep, now.outliers)
    # All that was seen, with the poses of the pass's end: those of its beginning left tracks out that these find, and
    # what a lens that was not found yet made an outlier may be none.
    shown = on_the_chain(inputs, outcome.state, factor.cameras)
    anew = replace(factor, noise=noise, keep=shown).cut(outcome.state, chain_cuts(factor.n_keyframes))
    left, share = look(anew, outcome.state), GOOD_AT_FIRST if first else GOOD
    # The next pass uses no observation that was not judged, as those of tracks that the poses do not find.
    judged = [_judged(anew, left, i, rig.settings, share) for i in range(len(shown))]
    return Following(noise, tuple(good for good, _ in judged), tuple(outliers for _, outliers in judged))


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
