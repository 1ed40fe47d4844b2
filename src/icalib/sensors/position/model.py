"""Model of a position sensor in the estimation problem: its frame, slow offset, noise and factors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from icalib.data.measurements import Measurements
from icalib.model.sensor_model import Pass, PassEnd, SensorModel, frame_entries
from icalib.motion.point_planes import PlaneAssociation
from icalib.optim.state import Entry, Key
from icalib.rig import Rig
from icalib.rig.scene import FRAME, LEVEL_FRAME
from icalib.sensors.position.frame import frame_owner
from icalib.sensors.position.residual import OffsetWalkFactor, PositionFactor, PositionNoise, knot_entries
from icalib.sensors.position.spec import LEVELLED, PositionSensor
from icalib.sensors.position.stream import PositionStream

FIRST_NOISE_M = 0.05  # of each axis if no noise is stated: between that of differential and of carrier-phase fixes
# Smallest entry of `PositionNoise` (m, or a factor): keeps the weights of fixes without any noise finite.
LEAST_NOISE = 1e-6


class PositionModel(SensorModel[PositionSensor, PositionNoise]):
    """Noise that is not stated is estimated as chi^2 over degrees of freedom, separately for
    horizontal and vertical residuals. The trajectory absorbs some of the noise, so that two passes estimate it."""

    def scene_entries(self, sensor: PositionSensor, rig: Rig, n_recordings: int) -> list[Entry]:
        """Entries of the sensor's frame in each recording, unless it shares a frame; then the knots of the slow offset.
        A frame has yaw and origin if it and the world are levelled, else rotation and origin."""
        knots = knot_entries(sensor.name, n_recordings) if sensor.position_random_walk else []
        if not sensor.has_frame:
            return knots
        levelled = rig.imu is not None and not rig.assumes_motion and sensor.frame == LEVELLED
        return frame_entries(sensor.name, n_recordings, specs=LEVEL_FRAME if levelled else FRAME) + knots

    def keyframe_times(
        self, sensors: Sequence[PositionSensor], rig: Rig, streams: Mapping[str, Any], values: Mapping[Key, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """None if the motion is assumed to be smooth: other sensors then place keyframes densely enough."""
        return {} if rig.assumes_motion else super().keyframe_times(sensors, rig, streams, values)

    def first_noise(
        self, sensors: Sequence[PositionSensor], rig: Rig, measurements: Measurements
    ) -> dict[str, PositionNoise]:
        """The stated noise [m] if the rig file has a number; else 1, a factor on the standard deviations of
        `weighted`."""
        sizes = {s.name: s.position_noise if isinstance(s.position_noise, float) else 1.0 for s in sensors}
        loss, scale = rig.settings.loss, rig.settings.loss_scale
        return {name: PositionNoise(size, size, loss, scale) for name, size in sizes.items()}

    def next_noise(
        self, sensors: Sequence[PositionSensor], noise: Mapping[str, PositionNoise], end: PassEnd
    ) -> dict[str, PositionNoise]:
        next_noise = {s.name: noise[s.name] for s in sensors}
        for name in (s.name for s in sensors if s.position_noise is None):
            factors, now = end.of(name).variance_factors(), noise[name]
            horizontal, vertical = (
                max(size * float(np.sqrt(factors.get(kind, 1.0))), LEAST_NOISE)
                for kind, size in (("horizontal", now.horizontal), ("vertical", now.vertical))
            )
            next_noise[name] = replace(now, horizontal=horizontal, vertical=vertical)
        return next_noise

    def passes(
        self, sensors: Sequence[PositionSensor], rig: Rig, measurements: Measurements, association: PlaneAssociation
    ) -> int:
        return 2 * any(s.position_noise is None for s in sensors)

    def factors(
        self, sensor: PositionSensor, stream: PositionStream, noise: PositionNoise, at: Pass
    ) -> Iterator[PositionFactor | OffsetWalkFactor]:
        """The factor of all fixes, and that of their slow offset if the rig file states one. Fixes whose residuals at
        the begin of the pass are outliers are rejected."""
        assert at.motion is not None
        density, deviations = sensor.position_random_walk, at.rig.settings.outlier_std
        factor = PositionFactor.build(weighted(sensor, stream), at.motion, noise, at.layout, frame_owner(sensor))
        factor = factor.with_slow_offset(stream, density) if density else factor
        # The trajectory at the begin of the first pass follows the fixes, so that residuals show no outliers.
        yield factor if at.coarse or deviations <= 0.0 else factor.without_outliers(at.state, deviations)
        if density:
            yield OffsetWalkFactor.build(stream, at.motion, density, at.layout)


def weighted(sensor: PositionSensor, stream: PositionStream) -> PositionStream:
    """The stream with the covariances that `PositionNoise` multiplies. They are empty if the rig file states the noise
    in metres; else those of the recording, or FIRST_NOISE_M of each axis if it has none."""
    n = len(stream.stamps_ns)
    if isinstance(sensor.position_noise, float):
        return replace(stream, covariance=np.zeros((0, 3, 3)))
    if len(stream.covariance):
        return stream
    return replace(stream, covariance=np.tile(FIRST_NOISE_M**2 * np.eye(3), (n, 1, 1)))


MODEL = PositionModel()
