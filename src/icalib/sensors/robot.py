"""LiDARs, wheels and pose sensors of a rig: what they add to the border, and their factors in one pass."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import LidarStream, Measurements, PoseStream, WheelPoses, WheelStream
from icalib.motion.clocks import instants
from icalib.motion.factor import SensorFactor
from icalib.motion.point_planes import count_points, thinned
from icalib.motion.sweep import Motion
from icalib.optim.state import Entry, Key, Layout, State
from icalib.rig import Lidar, ParameterSpec, PoseSensor, Rig, Sensor, Settings, Wheels
from icalib.rig.scene import FRAME, PLANE
from icalib.rig.sensor import TIME_OFFSET
from icalib.sensors.lidar.lidar_binning import BIN_S, LidarNoise
from icalib.sensors.lidar.residual import LidarFactor
from icalib.sensors.pose.residual import AbsolutePoseFactor, PoseFactor, PoseNoise, RelativePosesFactor, frame_of
from icalib.sensors.wheels.ground_factor import GroundFactor, floors
from icalib.sensors.wheels.residual import IncrementFactor, RelativePoseFactor, WheelNoise
from icalib.sensors.wheels.wheel_angles import integrals_of

NEAR_PLANE_M = 1e-3  # of a point's distance whatever the direction: what the model lacks where beams graze a plane
FIRST_RANGE_M = 0.03  # of a LiDAR whose noise is not given
LEAST_RANGE_M = 1e-3
COARSE_BIN_S = 11e-3
FEWEST_POINTS = 100  # of a plane
# Of a pose sensor whose noise is not given: rad, m; of relative poses rad/sqrt(s), m/sqrt(s).
FIRST_POSE_NOISE = 0.01, 0.02
LEAST_POSE_NOISE = 1e-6


@dataclass(frozen=True)
class Clouds:
    """Which plane each point lies on. names (P,): of the planes, no sensor is called so; plane (N,) int32 by LiDAR:
    index of each point's plane, -1: none."""

    names: tuple[str, ...]
    plane: tuple[np.ndarray, ...]

    @property
    def count(self) -> int:
        return len(self.names)

    @property
    def keys(self) -> tuple[Key, ...]:
        """Where the planes' values stand in a state."""
        return tuple((name, PLANE.name) for name in self.names)

    @property
    def recording(self) -> np.ndarray:
        """(P,) number of the recording that each plane belongs to, see `joined_clouds`."""
        numbers = (name.removeprefix("plane ").split(".") for name in self.names)
        return np.array([int(n[0]) - 1 if len(n) > 1 else 0 for n in numbers], dtype=np.int64)

    @property
    def entries(self) -> list[Entry]:
        """The planes as parameters of a layout."""
        return [PLANE.entry(name) for name in self.names]

    @property
    def points(self) -> np.ndarray:
        """(P,) how many lie on each plane."""
        return sum((count_points(p, self.count) for p in self.plane), np.zeros(self.count, dtype=np.int64))


NO_CLOUDS = Clouds((), ())


def joined_clouds(each: Sequence[Clouds]) -> Clouds:
    """Of recordings whose points follow one another. Each has a world and planes of its own: "plane 2.0" is of the
    second recording."""
    if len(each) == 1:
        return each[0]
    names = tuple(f"plane {r}.{own.removeprefix('plane ')}" for r, c in enumerate(each, 1) for own in c.names)
    first = np.cumsum([0, *(c.count for c in each)])
    pairs = zip(*(c.plane for c in each), strict=True)
    plane = (
        np.concatenate([np.where(p >= 0, p + n, -1) for p, n in zip(own, first, strict=False)]).astype(np.int32)
        for own in pairs
    )
    return Clouds(names, tuple(plane))


def own_entries(
    sensor: Sensor, n_recordings: int = 1, is_estimated: Callable[[ParameterSpec], bool] | None = None
) -> list[Entry]:
    """The parameters of a sensor; a clock that restarts has a time offset in each recording."""
    n_clocks = n_recordings if getattr(sensor, "clock_restarts", False) else 1
    specs = (spec.in_recordings(n_clocks) if spec == TIME_OFFSET else spec for spec in sensor.specs())
    free = is_estimated or sensor.is_estimated
    return [spec.entry(sensor.name, free(spec)) for spec in specs]


def frame_entries(sensor: PoseSensor, n_recordings: int, estimated: bool = True) -> list[Entry]:
    """Of the border: where the frame of absolute poses stands in each recording's world."""
    frames = [frame_of(sensor.name, k) for k in range(n_recordings if sensor.kind == "absolute" else 0)]
    return [spec.entry(frame, estimated) for frame in frames for spec in FRAME]


def known_planes(streams: Sequence[LidarStream]) -> Clouds:
    """The association that streams come with, planes with few points left out."""
    most = max((int(s.plane.max(initial=-1)) for s in streams), default=-1) + 1
    count = sum((count_points(s.plane, most) for s in streams), np.zeros(most, dtype=np.int64))
    used = np.flatnonzero(count >= FEWEST_POINTS)
    own = np.full(most + 1, -1, dtype=np.int32)
    own[used] = np.arange(len(used))
    return Clouds(tuple(f"plane {k}" for k in used), tuple(own[s.plane] for s in streams))


def first_ranging(lidar: Lidar, settings: Settings) -> LidarNoise:
    """Noise of a LiDAR before its residuals are known: as the rig file has it, along the beam, or alike in all
    directions."""
    loss, scale = settings.loss, settings.loss_scale
    if lidar.range_noise_m is None:
        return LidarNoise(FIRST_RANGE_M, 0.0, loss, scale)
    return LidarNoise(NEAR_PLANE_M, lidar.range_noise_m, loss, scale)


def next_ranging(lidar: Lidar, noise: LidarNoise, chi2: float, count: int) -> LidarNoise:
    """With the size that `chi2` of `count` points shows, where the rig file has none."""
    if lidar.range_noise_m is not None:
        return noise
    sigma = max(noise.sigma * float(np.sqrt(chi2 / count)), LEAST_RANGE_M)
    return LidarNoise(sigma, 0.0, noise.loss, noise.loss_scale)


def first_posing(sensor: PoseSensor, settings: Settings) -> PoseNoise:
    """Noise of a pose sensor before its residuals are known."""
    turn, way = FIRST_POSE_NOISE
    turn = turn if sensor.rotation_noise is None else sensor.rotation_noise
    way = way if sensor.position_noise is None else sensor.position_noise
    return PoseNoise(turn, way, settings.loss, settings.loss_scale)


def next_posing(sensor: PoseSensor, noise: PoseNoise, ratios: dict[str, float]) -> PoseNoise:
    """With the sizes that chi^2 over degrees of freedom shows, by kind of row, where the rig file has none. A kind that
    `ratios` lacks stays as it is."""
    turn, way = (
        max(size * float(np.sqrt(ratios.get(kind, 1.0))), LEAST_POSE_NOISE)
        for kind, size in (("rotation", noise.rotation), ("position", noise.position))
    )
    turn = turn if sensor.rotation_noise is None else noise.rotation
    way = way if sensor.position_noise is None else noise.position
    return PoseNoise(turn, way, noise.loss, noise.loss_scale)


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
        ranging = tuple(first_ranging(x, rig.settings) for x in rig.lidars)
        return cls(ranging, tuple(first_posing(x, rig.settings) for x in rig.poses), True)


NO_ROBOT = RobotNoise()


def robot_factors(
    rig: Rig, measurements: Measurements, clouds: Clouds, noise: RobotNoise, motion: Motion, layout: Layout
) -> tuple[SensorFactor, ...]:
    """Of LiDARs, if points are known to lie on planes, of wheels and of pose sensors, everything frozen that a pass
    freezes."""
    bin_s = COARSE_BIN_S if noise.coarse else BIN_S
    lidars = (
        LidarFactor.build(
            stream,
            thinned(plane) if noise.coarse else plane,
            clouds.keys,
            motion,
            size,
            layout,
            rig.settings.scheme,
            bin_s,
        )
        for stream, plane, size in zip(measurements.lidars, clouds.plane, noise.ranging, strict=False)
    )
    wheels = (
        wheel_factor(sensor, rig.settings, stream, motion, layout)
        for sensor, stream in zip(rig.wheels, measurements.wheels, strict=True)
    )
    poses = (
        pose_factor(sensor, stream, motion, size, layout)
        for sensor, stream, size in zip(rig.poses, measurements.poses, noise.posing, strict=True)
    )
    return (*(lidars if clouds.count else ()), *wheels, *ground_factors(rig, clouds, motion, layout), *poses)


def still_factors(
    rig: Rig, streams: Sequence[PoseStream], noise: RobotNoise, state: State, starts: tuple[int, ...], layout: Layout
) -> tuple[SensorFactor, ...]:
    """Of pose sensors without an IMU; starts: the first node of each recording."""
    sensors = zip(rig.poses, streams, noise.posing, strict=True)
    return tuple(AbsolutePoseFactor.at_nodes(stream, state, starts, size, layout) for _, stream, size in sensors)


def ground_factors(rig: Rig, clouds: Clouds, motion: Motion, layout: Layout) -> Iterator[GroundFactor]:
    """Of wheels that stand on a plane; of the floor once it is seen."""
    for wheels in rig.wheels:
        if wheels.ground is not None:
            state = motion.state
            floor: tuple[Key | None, ...] = (None,) * len(state.recordings)
            if wheels.ground.plane == "floor" and clouds.count:
                floor = floors(state, clouds.keys, clouds.points, clouds.recording)
            yield GroundFactor.build(wheels.name, wheels.ground, floor, state, motion.imu, layout)


def pose_factor(sensor: PoseSensor, stream: PoseStream, motion: Motion, noise: PoseNoise, layout: Layout) -> PoseFactor:
    kind = AbsolutePoseFactor if sensor.kind == "absolute" else RelativePosesFactor
    return kind.build(stream, motion, noise, layout)


def wheel_factor(
    wheels: Wheels, settings: Settings, stream: WheelStream | WheelPoses, motion: Motion, layout: Layout
) -> IncrementFactor | RelativePoseFactor:
    noise = WheelNoise(
        wheels.wheel_noise, wheels.lateral_slip, wheels.vertical_slip, settings.loss, settings.loss_scale,
        wheels.speed_noise, wheels.yaw_noise, wheels.steering_noise,
    )  # fmt: skip
    if isinstance(stream, WheelPoses):
        return RelativePoseFactor.of_poses(stream, motion.imu, motion.gravity, noise, layout, motion.state)
    own = wheels.name, stream.seconds, integrals_of(stream), motion.imu, motion.gravity, noise, layout, motion.state
    times = instants(stream, motion.state.values)
    if wheels.factor == "relative-poses":
        return RelativePoseFactor.build(*own, times)
    return IncrementFactor.build(*own, stream.kind, times)
