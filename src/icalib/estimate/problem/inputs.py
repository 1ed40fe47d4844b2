"""What an estimate is of: the rig, what was measured, and the border that both make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from icalib.data.joining import Part, join
from icalib.data.measurements import Measurements, Stream
from icalib.estimate.problem.tolerances import Tolerances
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets.base import BOARD
from icalib.motion.imu_data import ImuData, joined_imu_data
from icalib.motion.imu_model import N_INTRINSICS
from icalib.optim.state import Entry, Kind, Layout, State, in_recording, make_layout
from icalib.rig import Camera, Lidar, PoseSensor, Rig, Wheels
from icalib.sensors.camera.bodies import Bodies, choose_bodies, restrict
from icalib.sensors.camera.images import on_common_images
from icalib.sensors.robot import NO_CLOUDS, Clouds, frame_entries, own_entries

CAMERA_PARAMETERS: tuple[tuple[str, Kind], ...] = (
    ("rotation", "rotation"),
    ("translation", "vector"),
    ("time_offset", "vector"),
    ("intrinsics", "vector"),
    ("distortion", "vector"),
    ("bloom", "vector"),
)
SIZES = {"rotation": 3, "translation": 3, "intrinsics": 4, "bloom": 1}


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
    tolerances: Tolerances
    parts: tuple[Part, ...]
    clouds: Clouds = NO_CLOUDS
    guess: State | None = None
    asked: Rig | None = None

    @property
    def sensors(self) -> tuple[Camera | Lidar | Wheels | PoseSensor, ...]:
        """All that take part, but for the IMU."""
        lidars = self.rig.lidars if self.clouds.count else ()
        return (*self.rig.cameras, *lidars, *self.rig.wheels, *self.rig.poses)

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
    tolerances = Tolerances.asked_for(rig.settings)
    return Inputs(rig, joined, bodies, joined_imu_data(rig, parts, joined), layout, tolerances, parts)


def with_clouds(inputs: Inputs, clouds: Clouds) -> Inputs:
    """The same with points of the LiDARs on planes."""
    layout = layout_for(inputs.rig, inputs.bodies, len(inputs.parts), clouds)
    return replace(inputs, layout=layout, clouds=clouds)


def layout_for(rig: Rig, bodies: Bodies, n_recordings: int = 1, clouds: Clouds = NO_CLOUDS) -> Layout:
    """The border: IMU intrinsics, the scene and its bodies, then each sensor's parameters, and planes."""
    imu = rig.imu
    entries: list[Entry] = []
    if imu is not None:
        entries.append((imu.name, "intrinsics", "nuisance", N_INTRINSICS, imu.intrinsics.mode != "fixed"))
    # Without an IMU the scene's frame is the world's, in all recordings.
    levelled = imu is not None and not rig.assumes_motion
    for k in range(1 if imu is None else n_recordings) if bodies.used else ():
        entries.append((in_recording(BOARD, k), "tilt", "tilt", 2, levelled))
    entries += bodies.size_entries() + bodies.shape_entries()
    for camera in rig.cameras:
        sizes = SIZES | {"distortion": len(camera_model(camera.model).parameter_names) - 4}
        sizes["time_offset"] = n_recordings if camera.clock_restarts else 1
        for name, kind in CAMERA_PARAMETERS:
            entries.append((camera.name, name, kind, sizes[name], _is_estimated(rig, camera, name)))
    for sensor in (*(rig.lidars if clouds.count else ()), *rig.wheels, *rig.poses):
        entries += own_entries(sensor, n_recordings)
    for k, sensor in enumerate(rig.poses):
        is_world = (imu is None or rig.assumes_motion) and rig.moves_by_poses and k == 0
        entries += frame_entries(sensor, n_recordings, not is_world)
    return make_layout(entries + bodies.pose_entries() + clouds.entries)


def _is_estimated(rig: Rig, camera: Camera, name: str) -> bool:
    if rig.imu is None and (name == "time_offset" or (camera.name == rig.body and name in ("rotation", "translation"))):
        return False
    return getattr(camera, name).mode != "fixed" and (name != "bloom" or rig.blooms)


def origin_difference(measurements: Measurements, stream: Stream) -> float:
    """Seconds from the body's first stamp to the sensor's, each on its own clock: what a raw time offset lacks."""
    return (stream.origin_ns - measurements.origin_ns) * 1e-9
