"""Model of a position sensor in the estimation problem: its frame, slow offset, noise and factors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from icalib.model.sensor_model import Pass, ResidualStatistics, SensorModel, frame_entries
from icalib.optim.state import Entry
from icalib.rig import Rig, Settings
from icalib.rig.scene import FRAME, LEVEL_FRAME
from icalib.sensors.position.frame import frame_owner
from icalib.sensors.position.residual import OffsetWalkFactor, PositionFactor, PositionNoise, knot_entries
from icalib.sensors.position.spec import LEVELLED, PositionSensor
from icalib.sensors.position.stream import PositionStream

FIRST_NOISE_M = 0.05  # of each axis if no noise is stated: between that of differential and of carrier-phase fixes
# Smallest entry of `PositionNoise` (m, or a factor): keeps the weights of fixes without any noise finite.
LEAST_NOISE = 1e-6


class PositionModel(SensorModel[PositionSensor, PositionNoise]):
    """See `SensorModel`. Noise that is not stated is estimated as chi^2 over degrees of freedom, separately for
    horizontal and vertical residuals. The trajectory absorbs some of the noise, so that two passes estimate it."""

    keyframes = "positions"

    def scene_entries(self, sensor: PositionSensor, rig: Rig, n_recordings: int) -> list[Entry]:
        """Entries of the sensor's frame in each recording, unless it shares a frame; then the knots of the slow offset.
        A frame has yaw and origin if it and the world are levelled, else rotation and origin."""
        knots = knot_entries(sensor.name, n_recordings) if sensor.position_random_walk else []
        if not sensor.has_frame:
            return knots
        levelled = rig.imu is not None and not rig.assumes_motion and sensor.frame == LEVELLED
        return frame_entries(sensor.name, n_recordings, specs=LEVEL_FRAME if levelled else FRAME) + knots

    def placing_keyframes(self, sensors: Sequence[PositionSensor], rig: Rig) -> Sequence[PositionSensor]:
        """None if the motion is assumed to be smooth: other sensors then place keyframes densely enough."""
        return () if rig.assumes_motion else sensors

    def first_noise(self, sensor: PositionSensor, settings: Settings) -> PositionNoise:
        """The stated noise [m] if the rig file has a number; else 1, a factor on the standard deviations of
        `weighted`."""
        size = sensor.position_noise
        first = 1.0 if size == "messages" or size is None else size
        return PositionNoise(first, first, settings.loss, settings.loss_scale)

    def next_noise(self, sensor: PositionSensor, noise: PositionNoise, statistics: ResidualStatistics) -> PositionNoise:
        if not self.noise_is_estimated(sensor):
            return noise
        factors = statistics.variance_factors()
        horizontal, vertical = (
            max(size * float(np.sqrt(factors.get(kind, 1.0))), LEAST_NOISE)
            for kind, size in (("horizontal", noise.horizontal), ("vertical", noise.vertical))
        )
        return replace(noise, horizontal=horizontal, vertical=vertical)

    def noise_passes(self, sensor: PositionSensor) -> int:
        return 2 if sensor.position_noise is None else 0

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
