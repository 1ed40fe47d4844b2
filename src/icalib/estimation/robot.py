"""LiDARs and wheels of a rig: what they add to the border, and their factors in one pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icalib.estimation.lidar_binning import LidarNoise
from icalib.estimation.lidar_factor import LidarFactor
from icalib.estimation.lidar_sweep import Motion
from icalib.estimation.sensors import SensorFactor
from icalib.estimation.state import Entry, Key, Kind, Layout
from icalib.estimation.wheel_angles import angles_from_rates
from icalib.estimation.wheel_factor import IncrementFactor, RelativePoseFactor, WheelNoise
from icalib.measurements import LidarStream, Measurements, WheelPoses, WheelStream
from icalib.rig import Lidar, Rig, Settings, Wheels

MOUNT: tuple[tuple[str, Kind, int], ...] = (
    ("rotation", "rotation", 3), ("translation", "vector", 3), ("time_offset", "vector", 1),
)  # fmt: skip
DRIVE: tuple[tuple[str, Kind, int], ...] = (("radii", "vector", 2), ("baseline", "vector", 1))
NEAR_PLANE_M = 1e-3  # of a point's distance whatever the direction: what the model lacks where beams graze a plane
FIRST_RANGE_M = 0.03  # of a LiDAR whose noise is not given
LEAST_RANGE_M = 1e-3
FEWEST_POINTS = 100  # of a plane


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
        return tuple((name, "plane") for name in self.names)

    @property
    def entries(self) -> list[Entry]:
        """The planes as parameters of a layout."""
        return [(*key, "plane", 3, True) for key in self.keys]

    @property
    def points(self) -> np.ndarray:
        """(P,) how many lie on each plane."""
        return sum(
            (np.bincount(p[p >= 0], minlength=self.count) for p in self.plane), np.zeros(self.count, dtype=np.int64)
        )


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


def own_entries(sensor: Lidar | Wheels) -> list[Entry]:
    """Of the border."""
    drive = DRIVE if isinstance(sensor, Wheels) else ()
    mute = drive if isinstance(sensor, Wheels) and sensor.measures == "poses" else ()  # of them poses say nothing
    return [(sensor.name, *g, getattr(sensor, g[0]).mode != "fixed" and g not in mute) for g in (*MOUNT, *drive)]


def known_planes(streams: Sequence[LidarStream]) -> Clouds:
    """The association that streams come with, planes with few points left out."""
    most = max((int(s.plane.max(initial=-1)) for s in streams), default=-1) + 1
    count = sum((np.bincount(s.plane[s.plane >= 0], minlength=most) for s in streams), np.zeros(most, dtype=np.int64))
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


def robot_factors(
    rig: Rig, measurements: Measurements, clouds: Clouds, ranging: Sequence[LidarNoise], motion: Motion, layout: Layout
) -> tuple[SensorFactor, ...]:
    """Of LiDARs, if points are known to lie on planes, and of wheels, everything frozen that a pass freezes."""
    lidars = (
        LidarFactor.build(stream, plane, clouds.keys, motion, noise, layout, rig.settings.scheme)
        for stream, plane, noise in zip(measurements.lidars, clouds.plane, ranging, strict=False)
    )
    wheels = (
        wheel_factor(sensor, rig.settings, stream, motion, layout)
        for sensor, stream in zip(rig.wheels, measurements.wheels, strict=True)
    )
    return (*(lidars if clouds.count else ()), *wheels)


def wheel_factor(
    wheels: Wheels, settings: Settings, stream: WheelStream | WheelPoses, motion: Motion, layout: Layout
) -> IncrementFactor | RelativePoseFactor:
    noise = WheelNoise(
        wheels.wheel_noise, wheels.sideways_slip, wheels.upwards_slip, settings.loss, settings.loss_scale
    )
    if isinstance(stream, WheelPoses):
        return RelativePoseFactor.of_poses(stream, motion.imu, motion.gravity, noise, layout, motion.state)
    kind = IncrementFactor if wheels.factor == "increments" else RelativePoseFactor
    angles = wheel_angles(stream)
    return kind.build(
        wheels.name, stream.seconds, angles, motion.imu, motion.gravity, noise, layout, motion.state
    )  # fmt: skip


def wheel_angles(stream: WheelStream) -> np.ndarray:
    """(N, 2) rad that both wheels have turned since the first stamp."""
    return angles_from_rates(stream.seconds, stream.rate, stream.meaning)
