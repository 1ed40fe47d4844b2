"""How large the errors of tracks are, and which observations stand out, judged from what a pass leaves behind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.estimation.arrowhead import chain_cuts
from icalib.estimation.assembly import Following, on_the_chain
from icalib.estimation.feature_factor import FeatureFactor, FeatureOutput
from icalib.estimation.inputs import Inputs
from icalib.estimation.medians import grouped_quantiles, largest_normal, median_variance
from icalib.estimation.outcome import Outcome
from icalib.rig import Camera, Settings

FIRST_GUESS_PX = 1.0
SMALLEST_PX = 0.005
# So many of an image's observations are no outliers. At first a lens that is not found yet leaves large errors at the
# edges, which are none either.
GOOD_AT_FIRST, GOOD = 0.9, 0.5


def first_following(inputs: Inputs) -> Following | None:
    """Before anything is known: what the rig file says, or a pixel; everything in use, tracks cut short, which costs
    little and leads near. None where there are no tracks."""
    if not inputs.measurements.tracks:
        return None
    sigma = tuple(c.track_noise_px or FIRST_GUESS_PX for c in inputs.rig.cameras)
    return Following(sigma, tuple(np.ones(len(t.uv), dtype=bool) for t in inputs.measurements.tracks), True)


def next_following(inputs: Inputs, outcome: Outcome, now: Following, first: bool) -> Following:
    """Of the next pass: noise as the residuals show it, where it is not given, and all observations but the outliers
    that stand out after the `first` pass or another."""
    rig, factor, out = inputs.rig, outcome.problem.features, outcome.residuals.features
    assert factor is not None and out is not None
    sigma = tuple(_sigma(c, factor, out, i) for i, c in enumerate(rig.cameras))
    if rig.settings.outlier_std <= 0.0:
        return Following(sigma, now.keep)
    # All that was seen, with the poses of the pass's end: those of its beginning left tracks out that these find, and
    # what a lens that was not found yet made an outlier may be none.
    shown = on_the_chain(inputs, outcome.state, factor.cameras)
    anew = replace(factor, sigma=sigma, keep=shown).cut(outcome.state, chain_cuts(factor.n_nodes))
    left, share = anew.look(outcome.state), GOOD_AT_FIRST if first else GOOD
    return Following(sigma, tuple(_kept(anew, left, i, rig.settings, share) for i in range(len(shown))))


def _sigma(camera: Camera, factor: FeatureFactor, out: FeatureOutput, index: int) -> float:
    """From the median, so that outliers have no say; each point takes three of its observations' rows."""
    used = [root > 0.0 for root in out.root]
    if camera.track_noise_px is not None or not used[index].any():
        return camera.track_noise_px or factor.sigma[index]
    rows, points = 2 * sum(int(u.sum()) for u in used), factor.tracks.count
    variance = median_variance((out.residual[index][used[index]] ** 2).sum(axis=1))
    return max(float(np.sqrt(variance / max(1.0 - 3.0 * points / rows, 0.1))), SMALLEST_PX)


def _kept(factor: FeatureFactor, out: FeatureOutput, index: int, settings: Settings, share: float) -> np.ndarray:
    """(N,) bool: observations that are no outliers, and that the model can see; where the track is left out they stay.

    An outlier is `outlier_std` standard deviations above the mean of its image, and above `outlier_min_px`. Both are
    those of normal errors as large as that `share` of the image's: where few points are followed, one outlier alone
    would make mean and standard deviation so large that it is none.
    """
    stream = factor.streams[index]
    used, followed = out.root[index] > 0.0, factor.tracks.track[index] >= 0
    size, image = np.linalg.norm(out.residual[index], axis=1), stream.image
    most = grouped_quantiles(size[used], image[used], len(stream.stamps_ns), share)
    limit = np.maximum(largest_normal(settings.outlier_std, share) * most, settings.outlier_min_px)
    return ~(followed & (~used | (size > limit[image])))
