"""The inputs of an estimate: rig, measurements, and the layout of the calibration parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from icalib.data.joining import Part, join
from icalib.data.measurements import Measurements, Stream
from icalib.estimate.problem.tolerances import specs_of, tolerance_of
from icalib.geometry.targets.base import BOARD
from icalib.model.bodies import Bodies
from icalib.model.sensor_model import clocks_of, model_of
from icalib.motion.clouds import NO_CLOUDS, Clouds
from icalib.motion.imu_data import ImuData, joined_imu_data
from icalib.optim.state import Block, Entry, Key, Layout, State, in_recording, make_layout
from icalib.rig import Parameter, ParameterSpec, Rig, Sensor
from icalib.rig.scene import TILT
from icalib.sensors.camera.connected_bodies import choose_bodies, restrict
from icalib.sensors.camera.image_times import on_common_images


@dataclass(frozen=True)
class Inputs:
    """All that stays the same from pass to pass.

    bodies: bodies of the target in use. parts: the recordings that were joined to `measurements`. clouds: points on
    planes; sensors that show planes take part only with these. guess: the state before points were associated with
    planes. asked: the rig as the user gave it, if `rig` has more.
    """

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
    def sensors(self) -> tuple[Sensor, ...]:
        """The mounted sensors that take part."""
        return _taking_part(self.rig, self.clouds)

    @cached_property
    def owners(self) -> dict[str, Sensor]:
        """All sensors that take part, by name, the IMU first."""
        return {s.name: s for s in self.rig.sensors.values() if model_of(s).takes_part(s, self.clouds)}

    @cached_property
    def specs(self) -> dict[Key, ParameterSpec]:
        """Definitions of the blocks of the layout."""
        return specs_of(self.layout, self.owners.values())

    def stated(self, block: Block) -> Parameter | None:
        """The field of the rig file for a block of a sensor; None for blocks of the scene."""
        owner = self.owners.get(block.sensor)
        return None if owner is None else getattr(owner, block.name)

    @property
    def tolerance(self) -> np.ndarray:
        """(B,) of each calibration column."""
        return tolerance_of(self.layout, self.specs, self.rig.settings)

    def sensor(self, name: str) -> Any:
        """The sensor `name`, of the class of its kind."""
        return self.rig.sensors[name]

    def stream(self, name: str) -> Stream:
        """The stream of the sensor `name`; of a camera that of corners."""
        return self.measurements.streams[name]

    def clocks_of(self, sensor: Sensor) -> int:
        """How many time offsets it has."""
        return clocks_of(sensor, len(self.parts))

    def is_sensor(self, name: str) -> bool:
        """Whether `name` is a sensor's, not a body's of the target or a plane's."""
        return name == self.rig.reference or name in [s.name for s in self.sensors]

    @property
    def motions(self) -> tuple[Part, ...]:
        """The recordings, each with a chain and a board of its own; without an IMU all together, since then nothing
        ties the instants of even one."""
        if self.imu is not None:
            return self.parts
        everything = {key: slice(0, len(s.stamps_ns)) for key, s in self.measurements.streams.items()}
        return (Part(self.measurements, 0, everything, 0.0),)


def inputs_for(rig: Rig, recordings: Sequence[Measurements], whole: Inputs | None = None) -> Inputs:
    """Of one recording or several, joined; on the clock of `whole`, where these are some of its streams."""
    bodies = choose_bodies(rig.target, recordings, rig.settings.board_shape, rig)
    shifts = None if whole is None else [part.shift_ns for part in whole.parts]
    joined, parts = join(rig, [on_common_images(rig, restrict(bodies, r)) for r in recordings], shifts)
    layout = layout_for(rig, bodies, len(parts))
    return Inputs(rig, joined, bodies, joined_imu_data(rig, parts, joined), layout, parts)


def with_clouds(inputs: Inputs, clouds: Clouds) -> Inputs:
    """The same with points on planes."""
    layout = layout_for(inputs.rig, inputs.bodies, len(inputs.parts), clouds)
    return replace(inputs, layout=layout, clouds=clouds)


def layout_for(rig: Rig, bodies: Bodies, n_recordings: int = 1, clouds: Clouds = NO_CLOUDS) -> Layout:
    """The calibration parameters: IMU intrinsics, the scene and its bodies, then each sensor's parameters, and
    planes."""
    imu, sensors = rig.imu, _taking_part(rig, clouds)
    entries: list[Entry] = []
    if imu is not None:
        entries += model_of(imu).entries(imu, rig, n_recordings)
    # Without an IMU the scene's frame is the world's, in all recordings.
    levelled = imu is not None and not rig.assumes_motion
    for k in range(1 if imu is None else n_recordings) if bodies.used else ():
        entries.append(TILT.entry(in_recording(BOARD, k), levelled))
    entries += bodies.size_entries() + bodies.shape_entries()
    for sensor in sensors:
        entries += model_of(sensor).entries(sensor, rig, n_recordings)
    for sensor in sensors:
        entries += model_of(sensor).scene_entries(sensor, rig, n_recordings)
    return make_layout(entries + bodies.pose_entries() + clouds.entries)


def _taking_part(rig: Rig, clouds: Clouds) -> tuple[Sensor, ...]:
    return tuple(s for s in rig.mounted if model_of(s).takes_part(s, clouds))


def origin_difference(measurements: Measurements, stream: Stream) -> float:
    """Seconds from the body's first stamp to the sensor's, each on its own clock: what a raw time offset lacks."""
    return (stream.origin_ns - measurements.origin_ns) * 1e-9
