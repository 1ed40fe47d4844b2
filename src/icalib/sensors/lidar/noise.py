"""Noise of a LiDAR from pass to pass."""

from __future__ import annotations

import numpy as np

from icalib.rig import Lidar, Settings
from icalib.sensors.lidar.lidar_binning import LidarNoise

NEAR_PLANE_M = 1e-3  # of a point's distance whatever the direction: what the model lacks where beams graze a plane
FIRST_RANGE_M = 0.03  # of a LiDAR whose noise is not given
LEAST_RANGE_M = 1e-3


def first_lidar_noise(lidar: Lidar, settings: Settings) -> LidarNoise:
    """Noise of a LiDAR before its residuals are known: as the rig file has it, along the beam, or alike in all
    directions."""
    loss, scale = settings.loss, settings.loss_scale
    if lidar.range_noise_m is None:
        return LidarNoise(FIRST_RANGE_M, 0.0, loss, scale)
    return LidarNoise(NEAR_PLANE_M, lidar.range_noise_m, loss, scale)


def next_lidar_noise(lidar: Lidar, noise: LidarNoise, chi2: float, count: int) -> LidarNoise:
    """With the size that `chi2` of `count` points shows, where the rig file has none."""
    if lidar.range_noise_m is not None:
        return noise
    sigma = max(noise.sigma * float(np.sqrt(chi2 / count)), LEAST_RANGE_M)
    return LidarNoise(sigma, 0.0, noise.loss, noise.loss_scale)
