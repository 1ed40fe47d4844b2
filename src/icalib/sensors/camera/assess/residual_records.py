"""Residuals of cameras that a result keeps: of corners of the target, and of feature tracks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.motion.factor import of_type, pairs_of
from icalib.motion.time_offsets import instants
from icalib.result.timeline import Timeline
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.features.residual import FeatureFactor
from icalib.sensors.camera.record import CornerResiduals, TrackResiduals


def residuals(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[CornerResiduals | TrackResiduals]:
    """Yields the corner residuals of each camera, then the track residuals of each camera if there are tracks."""
    yield from _corner_residuals(estimate, timeline)
    yield from _track_residuals(estimate, timeline)


def _corner_residuals(estimate: Estimate, timeline: Timeline) -> Iterator[CornerResiduals]:
    """Yields the corner residuals of each camera. A camera that saw no target has images without corners."""
    for i, (camera, corners) in enumerate(pairs_of(estimate.problem.factors, estimate.outcome.residuals, CornerFactor)):
        stream = camera.stream
        yield CornerResiduals(
            camera.name,
            _seconds(estimate, timeline, i),
            stream.start,
            stream.point,
            stream.uv,
            corners.residual,
            camera.noise.sigma,
            corners.root == 0.0,
        )


def _track_residuals(estimate: Estimate, timeline: Timeline) -> Iterator[TrackResiduals]:
    """Yields the track residuals of each camera; nothing if there are no tracks."""
    pairs = pairs_of(estimate.problem.factors, estimate.outcome.residuals, FeatureFactor)
    if not pairs:
        return
    factor, out = pairs[0]
    for i, (camera, stream) in enumerate(zip(factor.cameras, factor.streams, strict=True)):
        unused = (out.root[i] == 0.0)[:, None]
        residual = np.where(unused, np.nan, out.residual[i]).astype(np.float32)
        distance = np.linalg.norm(out.points[factor.tracks.camera == i], axis=1)
        yield TrackResiduals(
            camera.name,
            float(np.median(distance)) if len(distance) else None,
            _seconds(estimate, timeline, i),
            stream.start,
            stream.feature,
            stream.uv,
            residual,
            factor.sigmas[i].astype(np.float32),
            factor.outliers[i],
        )


def _seconds(estimate: Estimate, timeline: Timeline, index: int) -> np.ndarray:
    """(M,) instants [s] of the images of camera `index`, on the time axis of the result."""
    stream = of_type(estimate.problem.factors, CornerFactor)[index].stream
    return timeline.on_result_clock(instants(stream, estimate.outcome.state.values), timeline.recordings_of(stream.key))
