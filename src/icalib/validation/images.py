"""What is left of corners and tracks, on the result's clock."""

from __future__ import annotations

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.motion.clocks import instants
from icalib.motion.factor import of_type, pairs_of
from icalib.result import CornerResiduals, TrackResiduals
from icalib.result.timeline import Timeline
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.features.feature_factor import FeatureFactor


def corner_residuals(found: Estimate, timeline: Timeline) -> tuple[CornerResiduals, ...]:
    """By camera; those that saw no target have none in any image."""
    out = []
    for i, (camera, corners) in enumerate(pairs_of(found.problem.factors, found.outcome.residuals, CornerFactor)):
        stream = camera.stream
        out.append(
            CornerResiduals(
                camera.name,
                _seconds(found, timeline, i),
                stream.start,
                stream.point,
                stream.uv,
                corners.residual,
                camera.noise.sigma,
                corners.root == 0.0,
            )
        )
    return tuple(out)


def track_residuals(found: Estimate, timeline: Timeline) -> tuple[TrackResiduals, ...]:
    """By camera, where any of them follows points."""
    pairs = pairs_of(found.problem.factors, found.outcome.residuals, FeatureFactor)
    if not pairs:
        return ()
    (factor, left), out = pairs[0], []
    for i, (camera, stream) in enumerate(zip(factor.cameras, factor.streams, strict=True)):
        unused = (left.root[i] == 0.0)[:, None]
        residual = np.where(unused, np.nan, left.residual[i]).astype(np.float32)
        own = np.linalg.norm(left.points[factor.tracks.camera == i], axis=1)
        out.append(
            TrackResiduals(
                camera.name,
                float(np.median(own)) if len(own) else None,
                _seconds(found, timeline, i),
                stream.start,
                stream.feature,
                stream.uv,
                residual,
                factor.sigmas[i].astype(np.float32),
                factor.outliers[i],
            )
        )
    return tuple(out)


def _seconds(found: Estimate, timeline: Timeline, index: int) -> np.ndarray:
    """(M,) of the images of a camera."""
    times = instants(of_type(found.problem.factors, CornerFactor)[index].stream, found.outcome.state.values)
    return timeline.shown(times, timeline.of_images(index))
