"""LiDARs, wheels and pose sensors of a rig: what they add to the calibration parameters, and their factors in one
pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from icalib.data.measurements import Measurements
from icalib.motion.clouds import Clouds
from icalib.motion.factor import Factor
from icalib.motion.point_planes import thinned
from icalib.motion.sweep import Motion
from icalib.optim.state import Entry, Layout
from icalib.rig import ParameterSpec, Rig, Sensor
from icalib.sensors.lidar.lidar_binning import BIN_S, COARSE_BIN_S, LidarNoise
from icalib.sensors.lidar.noise import first_lidar_noise
from icalib.sensors.lidar.residual import LidarFactor
from icalib.sensors.pose.factors import first_pose_noise, pose_factor
from icalib.sensors.pose.residual import PoseNoise
from icalib.sensors.sensor import TIME_OFFSET
from icalib.sensors.wheels.factors import ground_factors, wheel_factor


def own_entries(
    sensor: Sensor, n_recordings: int = 1, is_estimated: Callable[[ParameterSpec], bool] | None = None
) -> list[Entry]:
    """The parameters of a sensor; a clock that restarts has a time offset in each recording."""
    n_clocks = n_recordings if getattr(sensor, "clock_restarts", False) else 1
    specs = (spec.in_recordings(n_clocks) if spec == TIME_OFFSET else spec for spec in sensor.specs())
    free = is_estimated or sensor.is_estimated
    return [spec.entry(sensor.name, free(spec)) for spec in specs]


@dataclass(frozen=True)
class RobotNoise:
    """Noise of the LiDARs and of the pose sensors, in the rig's order. coarse: whether of LiDARs fewer points count, in
    longer bins."""

    ranging: tuple[LidarNoise, ...] = ()
    posing: tuple[PoseNoise, ...] = ()
    coarse: bool = False

    @classmethod
    def first(cls, rig: Rig) -> RobotNoise:
        """Before any residuals are known: coarse, which costs little and leads near."""
        ranging = tuple(first_lidar_noise(x, rig.settings) for x in rig.lidars)
        return cls(ranging, tuple(first_pose_noise(x, rig.settings) for x in rig.poses), True)


NO_ROBOT = RobotNoise()


def robot_factors(
    rig: Rig, measurements: Measurements, clouds: Clouds, noise: RobotNoise, motion: Motion, layout: Layout
) -> tuple[Factor, ...]:
    """Of LiDARs, if points are known to lie on planes, of wheels and of pose sensors, everything frozen that a pass
    freezes."""
    bin_s, scheme = COARSE_BIN_S if noise.coarse else BIN_S, rig.settings.scheme
    factors: list[Factor] = []
    lidars = zip(measurements.lidars, clouds.plane, noise.ranging, strict=False)
    for stream, plane, size in lidars if clouds.count else ():
        used = thinned(plane) if noise.coarse else plane
        factors.append(LidarFactor.build(stream, used, clouds.keys, motion, size, layout, scheme, bin_s))
    for sensor, stream in zip(rig.wheels, measurements.wheels, strict=True):
        factors.append(wheel_factor(sensor, rig.settings, stream, motion, layout))
    factors += ground_factors(rig, clouds, motion, layout)
    for sensor, stream, size in zip(rig.poses, measurements.poses, noise.posing, strict=True):
        factors.append(pose_factor(sensor, stream, motion, size, layout))
    return tuple(factors)
