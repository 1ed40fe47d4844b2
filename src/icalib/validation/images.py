"""What is left of corners and tracks, on the result's clock."""

from __future__ import annotations

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.motion.clocks import instants
from icalib.result import CornerResiduals, TrackResiduals
from icalib.result.timeline import Timeline


def corner_residuals(found: Estimate, timeline: Timeline) -> tuple[CornerResiduals, ...]:
    """By camera; those that saw no target have none in any image."""
    out = []
    for i, (camera, corners) in enumerate(zip(found.problem.cameras, found.outcome.residuals.corners, strict=True)):
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
    factor, left = found.problem.features, found.outcome.residuals.features
    if factor is None or left is None:
        return ()
    out = []
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
    times = instants(found.problem.cameras[index].stream, found.outcome.state.values)
    return timeline.shown(times, timeline.of_images(index))
