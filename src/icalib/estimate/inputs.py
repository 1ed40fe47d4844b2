"""The inputs of an estimate: rig, measurements, and the layout of the calibration parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from icalib.data.measurements import Measurements, Part, Stream, join
from icalib.geometry.targets.base import BOARD
from icalib.kinds import models
from icalib.model.bodies import Bodies
from icalib.model.sensor_model import clocks_of, model_of, own_entries
from icalib.motion.imu_data import ImuData, joined_imu_data
from icalib.motion.point_planes import NO_ASSOCIATION, PlaneAssociation
from icalib.optim.state import Block, Entry, Key, Layout, State, in_recording, make_layout
from icalib.rig import Parameter, ParameterSpec, Rig, Sensor, Settings
from icalib.rig.scene import GRAVITY, SCENE, SHEET_MIDDLE, TILT, WORLD
from icalib.sensors.sensor import TIME_OFFSET


@dataclass(frozen=True)
class Inputs:
    """Inputs of an estimate that stay the same in all passes.

    bodies: bodies of the target in use. parts: the recordings that were joined to `measurements`. association: points
    on planes; sensors that measure planes are used only with them. guess: initial state, before points were associated
    with planes. user_rig: the rig as the user gave it, if `rig` has more.
    """

    rig: Rig
    measurements: Measurements
    bodies: Bodies
    imu: ImuData | None
    layout: Layout
    parts: tuple[Part, ...]
    association: PlaneAssociation = NO_ASSOCIATION
    guess: State | None = None
    user_rig: Rig | None = None

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """Mounted sensors that have parameters and factors."""
        return _taking_part(self.rig, self.association)

    @cached_property
    def owners(self) -> dict[str, Sensor]:
        """All sensors that have parameters and factors, by name, the IMU first."""
        return {s.name: s for s in self.rig.sensors.values() if _takes_part(s, self.association)}

    @cached_property
    def specs(self) -> dict[Key, ParameterSpec]:
        """Parameter definition of each block of the layout."""
        return specs_of(self.layout, self.owners.values())

    def stated(self, block: Block) -> Parameter | None:
        """Field of the rig file for a sensor's block; None for blocks of the scene."""
        owner = self.owners.get(block.sensor)
        return None if owner is None else getattr(owner, block.name)

    @property
    def tolerance(self) -> np.ndarray:
        """(B,) tolerance of each calibration column, see `tolerance_of`."""
        return tolerance_of(self.layout, self.specs, self.rig.settings)

    def sensor(self, name: str) -> Any:
        """Sensor `name` of the rig, of the class of its kind."""
        return self.rig.sensors[name]

    def stream(self, name: str) -> Stream:
        """Measurements of the sensor `name`; for a camera, its corners."""
        return self.measurements.streams[name]

    def clocks_of(self, sensor: Sensor) -> int:
        """Number of time offsets of `sensor`: one, or one per recording if its clock restarts."""
        return clocks_of(sensor, len(self.parts))

    def is_sensor(self, name: str) -> bool:
        """Whether `name` is a sensor, and not a body of the target or a plane."""
        return name == self.rig.reference or name in [s.name for s in self.sensors]

    @property
    def motions(self) -> tuple[Part, ...]:
        """The recordings, each with its own chain and target attitude. Without an IMU a single part, because then no
        instants are linked."""
        if self.imu is not None:
            return self.parts
        everything = {key: slice(0, len(s.stamps_ns)) for key, s in self.measurements.streams.items()}
        return (Part(self.measurements, 0, everything, 0.0),)


def inputs_for(rig: Rig, recordings: Sequence[Measurements], whole: Inputs | None = None) -> Inputs:
    """Inputs of one or several recordings, joined. whole: inputs whose clock shifts are used, if `recordings` are some
    of their streams."""
    bodies = None
    for model in models().values():
        recordings, connected = model.prepared(rig, recordings)
        bodies = connected if bodies is None else bodies
    assert bodies is not None
    shifts = None if whole is None else [part.shift_ns for part in whole.parts]
    joined, parts = join(rig, recordings, shifts)
    layout = layout_for(rig, bodies, len(parts))
    return Inputs(rig, joined, bodies, joined_imu_data(rig, parts, joined), layout, parts)


def with_association(inputs: Inputs, association: PlaneAssociation) -> Inputs:
    """The same inputs with points on planes, and planes in the layout."""
    layout = layout_for(inputs.rig, inputs.bodies, len(inputs.parts), association)
    return replace(inputs, layout=layout, association=association)


def layout_for(
    rig: Rig, bodies: Bodies, n_recordings: int = 1, association: PlaneAssociation = NO_ASSOCIATION
) -> Layout:
    """Layout of the calibration parameters: IMU intrinsics, target, each sensor's parameters, frames in the scene,
    poses of bodies, planes."""
    imu, sensors = rig.imu, _taking_part(rig, association)
    entries: list[Entry] = []
    if imu is not None:
        entries += own_entries(imu, rig, n_recordings, association)
        entries += [GRAVITY.entry(WORLD)] if rig.gravity_sigma > 0.0 else []
    # Without an IMU the frame of the target is the world frame of all recordings.
    levelled = imu is not None and not rig.assumes_motion
    for k in range(1 if imu is None else n_recordings) if bodies.used else ():
        entries.append(TILT.entry(in_recording(BOARD, k), levelled))
    entries += bodies.size_entries() + bodies.shape_entries()
    entries += [SHEET_MIDDLE.entry(bodies.names[0])] if association.sheets else []
    for sensor in sensors:
        entries += own_entries(sensor, rig, n_recordings, association)
    for sensor in sensors:
        entries += model_of(sensor).scene_entries(sensor, rig, n_recordings)
    further = [s.name for s in sensors if s.is_inertial]
    layout = make_layout(entries + bodies.pose_entries() + association.entries, further)
    return replace(layout, shows_places=not rig.imus_alone)


def _taking_part(rig: Rig, association: PlaneAssociation) -> tuple[Sensor, ...]:
    """Mounted sensors that have parameters and factors."""
    return tuple(s for s in rig.mounted if _takes_part(s, association))


def _takes_part(sensor: Sensor, association: PlaneAssociation) -> bool:
    """Whether the sensor has parameters and factors: one that shows planes only once these are known."""
    return association.count > 0 or association.at_rest or not sensor.shows_planes


def origin_difference(measurements: Measurements, stream: Stream) -> float:
    """First stamp of the sensor minus that of the body [s], each on its own clock. Added to the time offset of raw
    stamps, it gives the offset of times since these first stamps."""
    return (stream.origin_ns - measurements.origin_ns) * 1e-9


# Parameter definitions of the blocks of a layout, and the tolerance of each calibration column.

UNGUESSED_SIGMA = 0.03  # rad or m: prior uncertainty of start values that nobody guessed, such as gravity's direction
# prior uncertainty of a translation without a guess in the rig file, about the program's start value
UNGUESSED_TRANSLATION_SIGMA_M = 0.5


def specs_of(layout: Layout, sensors: Iterable[Sensor]) -> dict[Key, ParameterSpec]:
    """Parameter definition of each block: from its sensor among `sensors`, else from the scene."""
    sensor_specs = {sensor.name: {spec.name: spec for spec in sensor.specs()} for sensor in sensors}
    scene = {spec.name: spec for spec in SCENE}
    block_specs = {b.key: sensor_specs.get(b.sensor, scene)[b.name] for b in layout.blocks}
    return block_specs | {b.key: TIME_OFFSET.in_recordings(b.size) for b in layout.blocks if b.name == TIME_OFFSET.name}


def tolerance_of(layout: Layout, specs: Mapping[Key, ParameterSpec], settings: Settings) -> np.ndarray:
    """(B,) tolerance of each calibration column: a parameter with a smaller standard deviation is `determined`. Units:
    rad, m, s, and px for image quantities."""
    out = np.zeros(layout.size)
    for b in layout.free:
        tolerance = specs[b.key].tolerance
        out[b.columns] = settings.tolerance(tolerance) if isinstance(tolerance, str) else tolerance
    return out


# Iteration over, and replacement of, the parameter groups of the sensors of a rig.


def groups_of(rig: Rig) -> Iterator[tuple[Sensor, str, Parameter]]:
    """Yields (sensor, name of the group, group) of all sensors, but not priors of a class of sensors."""
    for sensor in rig.sensors.values():
        for name, value in vars(sensor).items():
            if isinstance(value, Parameter) and not value.of_class:
                yield sensor, name, value


def usual(sensor: Sensor, name: str) -> Parameter:
    """How the group is estimated of which the rig file says nothing."""
    default: Parameter = getattr(type(sensor), name)
    return Parameter() if default.mode == "fixed" else default


def with_groups(rig: Rig, treated: Callable[[Sensor, str, Parameter], Parameter]) -> Rig:
    """The rig with each group of its sensors, see `groups_of`, replaced by `treated(sensor, name, group)`."""
    changed: dict[str, dict[str, Parameter]] = {}
    for sensor, name, group in groups_of(rig):
        changed.setdefault(sensor.name, {})[name] = treated(sensor, name, group)
    return rig.with_sensors(*(replace(rig.sensors[name], **groups) for name, groups in changed.items()))
