"""The sensor model of a LiDAR, with the factor of its points on planes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from icalib.data.measurements import LidarStream, Measurements
from icalib.model.sensor_model import Pass, PassEnd, SensorModel
from icalib.motion.factor import Factor, pairs_of
from icalib.motion.point_planes import PlaneAssociation, thinned
from icalib.optim.state import Key
from icalib.rig import Lidar, ParameterSpec, Rig
from icalib.sensors.lidar.binning import BIN_S, COARSE_BIN_S, LidarNoise, points_on_planes
from icalib.sensors.lidar.board_factor import ON_EDGES, BoardFactor
from icalib.sensors.lidar.patch_factor import PatchFactor
from icalib.sensors.lidar.residual import LidarFactor, true_rings
from icalib.sensors.lidar.spec import OF_RINGS, RANGE_OFFSET, RANGE_SCALE

# Isotropic noise in addition to stated range noise; without it beams parallel to a plane would have infinite weight.
GRAZING_SIGMA_M = 1e-3
FIRST_RANGE_SIGMA_M = 0.03  # in the first pass if the rig file states none: typical of a spinning LiDAR
MIN_RANGE_SIGMA_M = 1e-3  # of estimated noise: keeps weights of simulated points without noise finite


class LidarModel(SensorModel[Lidar, LidarNoise]):
    """Sensor model of a LiDAR, used once planes are known. Stated noise is along the beam; estimated noise is
    isotropic."""

    def is_estimated(self, sensor: Lidar, spec: ParameterSpec, rig: Rig, association: PlaneAssociation) -> bool:
        """See `SensorModel`. Surfaces that LiDARs at rest share show neither offset nor scale of ranges. The offset is
        always estimated on sheets, whose distance is known from images. Rings are estimated in motion only."""
        on_sheets = association.at_rest and rig.has_target
        if association.at_rest and spec in (OF_RINGS if on_sheets else (RANGE_OFFSET, RANGE_SCALE, *OF_RINGS)):
            return False
        if spec is RANGE_OFFSET and sensor.range_offset.value is None:
            k = [x.name for x in rig.lidars].index(sensor.name)
            on_sheets = on_sheets or bool(association.sheets and association.points_on_sheets[k].any())
            return on_sheets or sensor.range_offset.mode == "free"
        return super().is_estimated(sensor, spec, rig, association)

    def keyframe_times(
        self, sensors: Sequence[Lidar], rig: Rig, streams: Mapping[str, Any], values: Mapping[Key, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Times of scans; if the motion is assumed to be smooth, of those of the body alone."""
        placing = [s for s in sensors if not rig.assumes_motion or s.name == rig.reference_without_imu]
        return super().keyframe_times(placing, rig, streams, values)

    def first_noise(self, sensors: Sequence[Lidar], rig: Rig, measurements: Measurements) -> dict[str, LidarNoise]:
        loss, scale = rig.settings.loss, rig.settings.loss_scale
        stated = {s.name: s.range_noise_m for s in sensors}
        return {
            name: LidarNoise(FIRST_RANGE_SIGMA_M, 0.0, loss, scale)
            if noise is None
            else LidarNoise(GRAZING_SIGMA_M, noise, loss, scale)
            for name, noise in stated.items()
        }

    def next_noise(
        self, sensors: Sequence[Lidar], noise: Mapping[str, LidarNoise], end: PassEnd
    ) -> dict[str, LidarNoise]:
        """The noise scaled by the RMS of the whitened distances, unless the rig file states it. At rest, see
        `_on_boards`."""
        next_noise = {s.name: noise[s.name] for s in sensors}
        for sensor in sensors:
            points = end.of(sensor.name).squares.get("points") if sensor.range_noise_m is None else None
            if points is not None:
                sigma = noise[sensor.name].sigma * float(np.sqrt(points.chi2 / points.n))
                next_noise[sensor.name] = replace(noise[sensor.name], sigma=max(sigma, MIN_RANGE_SIGMA_M))
        for factor, out in pairs_of(end.factors, end.residuals, BoardFactor):
            sensor = next(s for s in sensors if s.name == factor.name)
            fit = end.of(sensor.name).fits[factor.kind]
            sizes = factor.noise_sizes(out, fit.count - fit.dof)
            next_noise[sensor.name] = _on_boards(sensor, next_noise[sensor.name], factor.kind, *sizes)
        for factor, _ in pairs_of(end.factors, end.residuals, PatchFactor):
            next_noise[factor.name] = replace(factor.noise, flatness=factor.measured_flatness(end.state))
        return next_noise

    def passes(
        self, sensors: Sequence[Lidar], rig: Rig, measurements: Measurements, association: PlaneAssociation
    ) -> int:
        if rig.imu is None:
            return 2  # the first estimate of errors that points share is rough
        return int(any(s.range_noise_m is None for s in sensors) or bool(association.sheets))

    def factors(self, sensor: Lidar, stream: LidarStream, noise: LidarNoise, at: Pass) -> Iterator[Factor]:
        """One factor for all points on planes, at rest for those on the target. Coarse passes use fewer points and
        longer bins."""
        if at.motion is None:
            yield from BoardFactor.build(true_rings(stream, at.state), noise, at) if at.rig.has_target else ()
            return
        plane = _plane(sensor, at)
        used, bin_s = (thinned(plane), COARSE_BIN_S) if at.coarse else (plane, BIN_S)
        scheme = at.rig.settings.scheme
        yield LidarFactor.build(stream, used, at.association.surfaces, at.motion, noise, at.layout, scheme, bin_s)
        if at.association.sheets and not at.coarse:
            yield from BoardFactor.build(true_rings(stream, at.state), noise, at)

    def joint_factors(
        self, sensors: Sequence[Lidar], factors: Sequence[Factor], noise: Mapping[str, LidarNoise], at: Pass
    ) -> Sequence[Factor]:
        """At rest without a target: the factor of all surfaces that the LiDARs share."""
        if at.motion is not None or at.rig.has_target:
            return ()
        return (PatchFactor.build(noise[at.rig.reference], at),)

    def points_on_planes(self, sensor: Lidar, stream: LidarStream, at: Pass) -> tuple[np.ndarray, np.ndarray]:
        """See `binning.points_on_planes`."""
        assert at.motion is not None
        plane = _plane(sensor, at)
        return points_on_planes(at.motion, stream, np.where(plane < at.association.count, plane, -1))


def _on_boards(sensor: Lidar, noise: LidarNoise, kind: str, sigma: float, inflation: float) -> LidarNoise:
    """The noise with what the residuals of one factor show, see `BoardFactor.noise_sizes`: of rings, or of points
    unless the rig file states it, and how far errors of the points at a stop correlate."""
    if kind == ON_EDGES:
        return replace(noise, edge_scale=max(inflation * sigma, 1.0))
    noise = replace(noise, inflation=inflation)
    return noise if sensor.range_noise_m is not None else replace(noise, sigma=max(sigma, MIN_RANGE_SIGMA_M))


def _plane(sensor: Lidar, at: Pass) -> np.ndarray:
    """(N,) index of the plane that each point lies on, -1: none."""
    return at.association.plane[[x.name for x in at.rig.lidars].index(sensor.name)]


MODEL = LidarModel()
