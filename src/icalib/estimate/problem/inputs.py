"""What an estimate is of: the rig, what was measured, and the calibration parameters that both make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from icalib.data.joining import Part, join
from icalib.data.measurements import Measurements, Stream
from icalib.estimate.problem.robot import own_entries
from icalib.estimate.problem.tolerances import specs_of, tolerance_of
from icalib.geometry.targets.base import BOARD
from icalib.motion.clouds import NO_CLOUDS, Clouds
from icalib.motion.imu_data import ImuData, joined_imu_data
from icalib.optim.state import Entry, Key, Layout, State, in_recording, make_layout
from icalib.rig import Camera, Lidar, ParameterSpec, PoseSensor, Rig, Wheels
from icalib.rig.scene import TILT
from icalib.sensors.camera.bodies import Bodies, choose_bodies, restrict
from icalib.sensors.camera.images import on_common_images
from icalib.sensors.camera.spec import BLOOM
from icalib.sensors.pose.factors import frame_entries
from icalib.sensors.sensor import MOUNTED, TIME_OFFSET


@dataclass(frozen=True)
class Inputs:
    """What does not change from pass to pass. bodies: what of the target is used; parts: the recordings that
    `measurements` were joined from; clouds: points of LiDARs on planes, without which these have no part in it; guess:
    where everything was before points were looked at by the plane; asked: the rig as it was given, where `rig` has
    more."""

    rig: Rig
    measurements: Measurements
    bodies: Bodies
    imu: ImuData | None
    layout: Layout
    parts: tuple[Part, ...]
    clouds: Clouds = NO_CLOUDS
    guess: State | None = None
    asked: Rig | None = None

    @property
    def sensors(self) -> tuple[Camera | Lidar | Wheels | PoseSensor, ...]:
        """All that take part, but for the IMU."""
        lidars = self.rig.lidars if self.clouds.count else ()
        return (*self.rig.cameras, *lidars, *self.rig.wheels, *self.rig.poses)

    @cached_property
    def specs(self) -> dict[Key, ParameterSpec]:
        """Definitions of the blocks of the layout."""
        return specs_of(self.layout, (*(() if self.rig.imu is None else (self.rig.imu,)), *self.sensors))

    @property
    def tolerance(self) -> np.ndarray:
        """(B,) of each calibration column."""
        return tolerance_of(self.layout, self.specs, self.rig.settings)

    def sensor(self, name: str) -> Camera | Lidar | Wheels | PoseSensor:
        return next(s for s in self.sensors if s.name == name)

    def stream(self, name: str) -> Stream:
        m = self.measurements
        return next(s for s in (*m.cameras, *m.lidars, *m.wheels, *m.poses) if s.name == name)

    def clocks_of(self, sensor: Camera | Lidar | Wheels | PoseSensor) -> int:
        """How many time offsets it has."""
        return len(self.parts) if sensor.clock_restarts else 1

    def is_sensor(self, name: str) -> bool:
        """Whether `name` is a sensor's, not a body's of the target or a plane's."""
        return name == self.rig.body or name in [s.name for s in self.sensors]

    @property
    def motions(self) -> tuple[Part, ...]:
        """The recordings, each with a chain and a board of its own; without an IMU all together, since then nothing
        ties the instants of even one."""
        if self.imu is not None:
            return self.parts
        everything = tuple(slice(0, len(c.stamps_ns)) for c in self.measurements.cameras)
        return (Part(self.measurements, 0, everything, 0.0),)


def inputs_for(rig: Rig, recordings: Sequence[Measurements], whole: Inputs | None = None) -> Inputs:
    """Of one recording or several, joined; on the clock of `whole`, where these are some of its streams."""
    bodies = choose_bodies(rig.target, recordings, rig.settings.board_shape, rig)
    shifts = None if whole is None else [part.shift_ns for part in whole.parts]
    joined, parts = join(rig, [on_common_images(rig, restrict(bodies, r)) for r in recordings], shifts)
    layout = layout_for(rig, bodies, len(parts))
    return Inputs(rig, joined, bodies, joined_imu_data(rig, parts, joined), layout, parts)


def with_clouds(inputs: Inputs, clouds: Clouds) -> Inputs:
    """The same with points of the LiDARs on planes."""
    layout = layout_for(inputs.rig, inputs.bodies, len(inputs.parts), clouds)
    return replace(inputs, layout=layout, clouds=clouds)


def layout_for(rig: Rig, bodies: Bodies, n_recordings: int = 1, clouds: Clouds = NO_CLOUDS) -> Layout:
    """The calibration parameters: IMU intrinsics, the scene and its bodies, then each sensor's parameters, and
    planes."""
    imu = rig.imu
    entries: list[Entry] = []
    if imu is not None:
        entries += own_entries(imu)
    # Without an IMU the scene's frame is the world's, in all recordings.
    levelled = imu is not None and not rig.assumes_motion
    for k in range(1 if imu is None else n_recordings) if bodies.used else ():
        entries.append(TILT.entry(in_recording(BOARD, k), levelled))
    entries += bodies.size_entries() + bodies.shape_entries()
    for camera in rig.cameras:
        entries += own_entries(camera, n_recordings, partial(_is_estimated, rig, camera))
    for sensor in (*(rig.lidars if clouds.count else ()), *rig.wheels, *rig.poses):
        entries += own_entries(sensor, n_recordings)
    for k, sensor in enumerate(rig.poses):
        is_world = (imu is None or rig.assumes_motion) and rig.moves_by_poses and k == 0
        entries += frame_entries(sensor, n_recordings, not is_world)
    return make_layout(entries + bodies.pose_entries() + clouds.entries)


def _is_estimated(rig: Rig, camera: Camera, spec: ParameterSpec) -> bool:
    if rig.imu is None and (spec == TIME_OFFSET or (camera.name == rig.body and spec in MOUNTED)):
        return False
    return camera.is_estimated(spec) and (spec != BLOOM or rig.blooms)


def origin_difference(measurements: Measurements, stream: Stream) -> float:
    """Seconds from the body's first stamp to the sensor's, each on its own clock: what a raw time offset lacks."""
    return (stream.origin_ns - measurements.origin_ns) * 1e-9
