"""Initial guess of position sensors: the trajectory from fixes and IMU, or lever arm, time offset and frame on a known
trajectory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from icalib.data.measurements import Measurements
from icalib.estimate.estimate import first_pass
from icalib.estimate.problem.assembly import keyframe_times, keyframes_for, motion_of, start_values
from icalib.estimate.problem.inputs import Inputs
from icalib.initialize.steps.contradicted_guesses import merged_values
from icalib.initialize.steps.initializer import BY_POSITIONS, Fixes, Initializer, InputsWithMotion, Values
from icalib.initialize.steps.rig_file_values import known_value, stated_values
from icalib.initialize.steps.single_recording import (
    KnownExtrinsics,
    converted_offset,
    fullest_recording,
    naming_recording,
    single_recording,
    state_of_recording,
    states_from_best,
)
from icalib.model.frames import frame_of
from icalib.optim.state import State
from icalib.rig import Rig
from icalib.rig.scene import FRAME_ROTATION, FRAME_TRANSLATION, FRAME_YAW
from icalib.sensors.position.frame import PositionFrame, frame_owner
from icalib.sensors.position.initialize.attitude import Fix
from icalib.sensors.position.initialize.placed import KnownPlace, PlacedSensor, place
from icalib.sensors.position.initialize.with_imu import motion_from_fixes
from icalib.sensors.position.read.outliers import single_wrong
from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.position.stream import PositionStream
from icalib.sensors.position.walk_factor import knot_keys

GUESSED_GROUPS = ("translation", "time_offset")


class PositionInitializer(Initializer[PositionSensor]):
    """See `Initializer`. The first position sensor gives the trajectory if no other kind of sensor does. Position
    sensors on a known trajectory get lever arm, time offset and frame."""

    def motion_rank(self, rig: Rig) -> int | None:
        """See `Initializer`. Positions need an IMU for the attitude, and a frame of their own for the world."""
        return BY_POSITIONS if rig.imu is not None and self._with_frame(rig) else None

    def sources(self, rig: Rig) -> tuple[str, ...]:
        return (self._with_frame(rig)[0].name,)

    def trajectory(self, inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> State:
        del fallback
        sensor = inputs.rig.of(PositionSensor)[0]
        state = states_from_best(inputs, sensor, fullest_recording(inputs, sensor.name), _state_of_one)
        frames = _frames(inputs, sensor, [(np.eye(3), np.zeros(3))] * len(inputs.parts))
        return replace(state, values=state.values | frames)

    def refined(self, inputs: Inputs, state: State) -> tuple[Inputs, State, Values]:
        state = first_pass(inputs, state)
        return inputs, state, state.values

    def cleaned(self, recording: Measurements) -> Measurements:
        """The recording without single wrong fixes, which would enlarge the estimated noise. Files are cleaned when
        they are read; this cleans measurements that were made in memory."""
        return recording.with_streams(
            *(s.some(~single_wrong(s.seconds, s.position)) for s in recording.of(PositionStream))
        )

    def fixes(self, recording: Measurements) -> list[Fixes]:
        """See `Initializer`."""
        return [Fixes(s.seconds, s.position[:, 0] + 1j * s.position[:, 1]) for s in recording.of(PositionStream)]

    def place(self, inputs: Inputs, state: State, sensors: Sequence[PositionSensor]) -> Values:
        """See `Initializer`. Sensors with a frame come first, because sensors without one may share it."""
        out: Values = {}
        for sensor in sorted(sensors, key=lambda s: not s.has_frame):
            out |= _on_motion(inputs, replace(state, values=state.values | out), sensor)
        return out

    @staticmethod
    def _with_frame(rig: Rig) -> list[PositionSensor]:
        """The sensors that share no frame of another sensor or of the target."""
        return [s for s in rig.of(PositionSensor) if s.has_frame]


INITIALIZER = PositionInitializer()


def _state_of_one(inputs: Inputs, extrinsics: KnownExtrinsics | None) -> State:
    """The state of one recording, with the frame of the fixes as world; extrinsics: found in another recording, or
    None."""
    assert inputs.imu is not None
    sensor = inputs.rig.of(PositionSensor)[0]
    known = extrinsics or _known_extrinsics(inputs, sensor)
    motion = motion_from_fixes(inputs.imu, sensor.name, _fix(inputs, sensor), inputs.rig.gravity, known)
    estimated = {
        (sensor.name, name): value
        for name, value in zip(GUESSED_GROUPS, (motion.best.at.arm, np.array([motion.best.at.offset])), strict=True)
    }
    values = start_values(inputs, merged_values(sensor, stated_values(inputs, sensor, GUESSED_GROUPS), estimated))
    keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
    rotation, position, velocity, bias = motion.at(keyframes)
    return State(keyframes, rotation, position, velocity, bias, values)


def _on_motion(inputs: Inputs, state: State, sensor: PositionSensor) -> Values:
    """Lever arm, time offset and frames of one sensor on the trajectory of `state`. The recording with most fixes gives
    the lever arm, and the time offset unless the clock restarts."""
    recordings = [single_recording(inputs, k) for k in range(len(inputs.parts))]
    best = fullest_recording(inputs, sensor.name)
    placed: dict[int, PlacedSensor] = {}
    for k in sorted(range(len(recordings)), key=lambda k: k != best):
        extrinsics, frame = _known_extrinsics(recordings[k], sensor), None
        if k != best:
            offset = converted_offset(placed[best].offset, sensor.name, recordings[best], recordings[k])
            offset = extrinsics.offset if sensor.clock_restarts else offset
            extrinsics = KnownExtrinsics(position=placed[best].arm, offset=offset)
        if not sensor.has_frame:
            frame = PositionFrame.of(frame_owner(sensor), k, state.values)
        known = KnownPlace(_is_levelled(inputs, sensor), extrinsics.position, extrinsics.offset, frame)
        with naming_recording(inputs, k):
            motion = motion_of(recordings[k], state_of_recording(inputs, k, state))
            placed[k] = place(motion, sensor.name, _fix(recordings[k], sensor), known)
    clocks = range(len(recordings)) if sensor.clock_restarts else (best,)
    offsets = [converted_offset(placed[k].offset, sensor.name, recordings[k], inputs) for k in clocks]
    estimated = {
        (sensor.name, GUESSED_GROUPS[0]): placed[best].arm,
        (sensor.name, GUESSED_GROUPS[1]): np.array(offsets),
    }
    frames = _frames(inputs, sensor, [(placed[k].R_wf, placed[k].p_wf) for k in range(len(recordings))])
    return merged_values(sensor, stated_values(inputs, sensor, GUESSED_GROUPS), estimated) | frames


def _known_extrinsics(inputs: Inputs, sensor: PositionSensor) -> KnownExtrinsics:
    """Lever arm and time offset that the rig file fixes or gives as a prior."""
    known = {name: value for (_, name), value in stated_values(inputs, sensor, GUESSED_GROUPS).items()}
    known = {name: value for name, value in known.items() if known_value(getattr(sensor, name)) is not None}
    offset = known.get("time_offset")
    return KnownExtrinsics(position=known.get("translation"), offset=None if offset is None else float(offset[0]))


def _fix(inputs: Inputs, sensor: PositionSensor) -> Fix:
    stream = inputs.stream(sensor.name)
    assert isinstance(stream, PositionStream)
    return Fix(stream.seconds, stream.position)


def _is_levelled(inputs: Inputs, sensor: PositionSensor) -> bool:
    """Whether the rotation of the sensor's frame in the world is a yaw alone."""
    return (frame_of(sensor.name, 0), FRAME_YAW.name) in {b.key for b in inputs.layout.blocks}


def _frames(inputs: Inputs, sensor: PositionSensor, frames: Sequence[tuple[np.ndarray, np.ndarray]]) -> Values:
    """Values of the sensor's frame in each recording, and zeros for the slow offset of the fixes. frames: R_world_frame
    (3, 3) and p_world_frame (3,) m of each recording. A shared frame has no values here."""
    out: Values = {}
    if sensor.position_random_walk:
        out |= {key: np.zeros(3) for k in range(len(frames)) for key in knot_keys(sensor.name, k, len(frames))}
    if not sensor.has_frame:
        return out
    levelled = _is_levelled(inputs, sensor)
    for k, (R, p) in enumerate(frames):
        name, value = (
            (FRAME_YAW.name, np.array([np.arctan2(R[1, 0], R[0, 0])])) if levelled else (FRAME_ROTATION.name, R)
        )
        out |= {(frame_of(sensor.name, k), name): value, (frame_of(sensor.name, k), FRAME_TRANSLATION.name): p}
    return out
