"""The sensor model of a LiDAR, with the factor of its points on planes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.model.sensor_model import Pass, ResidualStatistics, SensorModel
from icalib.motion.point_planes import PlaneAssociation, thinned
from icalib.rig import Lidar, Settings
from icalib.sensors.lidar.binning import BIN_S, COARSE_BIN_S, LidarNoise, points_on_planes
from icalib.sensors.lidar.residual import LidarFactor

# Isotropic noise in addition to stated range noise; without it beams parallel to a plane would have infinite weight.
GRAZING_SIGMA_M = 1e-3
FIRST_RANGE_SIGMA_M = 0.03  # in the first pass if the rig file states none: typical of a spinning LiDAR
MIN_RANGE_SIGMA_M = 1e-3  # of estimated noise: keeps weights of simulated points without noise finite


class LidarModel(SensorModel[Lidar, LidarNoise]):
    """Sensor model of a LiDAR, used once planes are known. Stated noise is along the beam; estimated noise is
    isotropic."""

    keyframes = "scans"

    def takes_part(self, sensor: Lidar, association: PlaneAssociation) -> bool:
        return association.count > 0

    def first_noise(self, sensor: Lidar, settings: Settings) -> LidarNoise:
        loss, scale = settings.loss, settings.loss_scale
        if sensor.range_noise_m is None:
            return LidarNoise(FIRST_RANGE_SIGMA_M, 0.0, loss, scale)
        return LidarNoise(GRAZING_SIGMA_M, sensor.range_noise_m, loss, scale)

    def next_noise(self, sensor: Lidar, noise: LidarNoise, statistics: ResidualStatistics) -> LidarNoise:
        """The noise scaled by the RMS of the whitened distances, unless the rig file states it."""
        points = statistics.squares.get("points")
        if sensor.range_noise_m is not None or points is None:
            return noise
        sigma = max(noise.sigma * float(np.sqrt(points.chi2 / points.n)), MIN_RANGE_SIGMA_M)
        return LidarNoise(sigma, 0.0, noise.loss, noise.loss_scale)

    def noise_passes(self, sensor: Lidar) -> int:
        return int(sensor.range_noise_m is None)

    def factors(self, sensor: Lidar, stream: LidarStream, noise: LidarNoise, at: Pass) -> Iterator[LidarFactor]:
        """One factor for all points on planes. Coarse passes use fewer points and longer bins."""
        assert at.motion is not None
        plane = _plane(sensor, at)
        used, bin_s = (thinned(plane), COARSE_BIN_S) if at.coarse else (plane, BIN_S)
        scheme = at.rig.settings.scheme
        yield LidarFactor.build(stream, used, at.association.keys, at.motion, noise, at.layout, scheme, bin_s)

    def points_on_planes(self, sensor: Lidar, stream: LidarStream, at: Pass) -> tuple[np.ndarray, np.ndarray]:
        """See `binning.points_on_planes`."""
        assert at.motion is not None
        return points_on_planes(at.motion, stream, _plane(sensor, at))


def _plane(sensor: Lidar, at: Pass) -> np.ndarray:
    """(N,) index of the plane that each point lies on, -1: none."""
    return at.association.plane[[x.name for x in at.rig.lidars].index(sensor.name)]


MODEL = LidarModel()
