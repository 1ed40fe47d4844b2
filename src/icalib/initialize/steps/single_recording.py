"""One recording of several. Each has a world frame of its own, and initial guesses use one recording at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np

from icalib.data.recordings.opening import naming
from icalib.estimate.problem.inputs import Inputs, origin_difference
from icalib.motion.imu_data import imu_data
from icalib.optim.state import Key, State
from icalib.rig import Sensor


@dataclass(frozen=True)
class KnownExtrinsics:
    """Known values of a sensor, None if unknown: R_imu_sensor (3, 3), p_imu_sensor (3,) m, offset: t_imu - t_sensor
    [s], both since their clocks' first stamps."""

    rotation: np.ndarray | None = None
    position: np.ndarray | None = None
    offset: float | None = None


NOTHING_KNOWN = KnownExtrinsics()


def single_recording(inputs: Inputs, k: int) -> Inputs:
    """Inputs of recording `k` alone, on its own clock. The rig needs an IMU."""
    if len(inputs.parts) == 1:
        return inputs
    part = inputs.parts[k]
    alone = replace(part, shift_ns=0, begin=0.0)
    return replace(inputs, measurements=part.measurements, imu=imu_data(inputs.rig, part.measurements), parts=(alone,))


def fullest_recording(inputs: Inputs, key: str) -> int:
    """Index of the recording in which the stream `key` has most measurements."""
    return int(np.argmax([part.measurements.streams[key].rows for part in inputs.parts]))


def naming_recording(inputs: Inputs, k: int) -> AbstractContextManager[None]:
    """A context in which errors are prefixed with the name of recording `k`, if there are several."""
    return naming(inputs.parts[k].name if len(inputs.parts) > 1 else "")


def state_of_recording(inputs: Inputs, k: int, state: State) -> State:
    """The part of `state` that belongs to recording `k`, on its own clock."""
    if len(inputs.parts) == 1:
        return state
    keyframes = state.recordings[k]
    seconds = state.seconds[keyframes] - inputs.parts[k].begin
    return State(
        seconds,
        state.rotation[keyframes],
        state.position[keyframes],
        state.velocity[keyframes],
        state.bias[keyframes],
        state.values,
    )


def joined_states(inputs: Inputs, states: Sequence[State], values: dict[Key, np.ndarray]) -> State:
    """The states of all recordings as one, with the calibration parameters `values`."""
    if len(states) == 1:
        return replace(states[0], values=values)
    seconds = np.concatenate([s.seconds + part.begin for s, part in zip(states, inputs.parts, strict=True)])
    rotation, position, velocity, bias = (
        np.concatenate([getattr(s, name) for s in states]) for name in ("rotation", "position", "velocity", "bias")
    )
    starts = np.cumsum([0, *(len(s.seconds) for s in states[:-1])])
    return State(seconds, rotation, position, velocity, bias, values, tuple(int(k) for k in starts))


def converted_offset(offset: float, sensor: str, before: Inputs, now: Inputs) -> float:
    """Converts a time offset [s] between the first stamps in `before` to one between the first stamps in `now`."""
    shifts = (origin_difference(i.measurements, i.stream(sensor)) for i in (now, before))
    return offset + next(shifts) - next(shifts)


def states_from_best(
    inputs: Inputs, sensor: Sensor, best: int, state_of: Callable[[Inputs, KnownExtrinsics | None], State]
) -> State:
    """The states of all recordings as one. Recording `best` starts without known values. The other recordings start
    with the extrinsics that `best` has shown, and with its time offset unless the clock restarts. state_of: estimates
    the state of one recording."""
    recordings = [single_recording(inputs, k) for k in range(len(inputs.parts))]
    restarts = sensor.clock_restarts
    with naming_recording(inputs, best):
        states = {best: state_of(recordings[best], None)}
    values, name = dict(states[best].values), sensor.name
    for k, recording in enumerate(recordings):
        if k != best:
            offset = None if restarts else _offset_between(states[best], name, recordings[best], recording)
            with naming_recording(inputs, k):
                states[k] = state_of(
                    recording, KnownExtrinsics(values.get((name, "rotation")), values[name, "translation"], offset)
                )
    clocks = range(len(recordings)) if restarts else (best,)
    offsets = [_offset_between(states[k], name, recordings[k], inputs) for k in clocks]
    values[name, "time_offset"] = np.array(offsets)
    return joined_states(inputs, [states[k] for k in range(len(recordings))], values)


def _offset_between(state: State, sensor: str, before: Inputs, now: Inputs) -> float:
    """The time offset in `state`, whose recording is `before`, converted to the first stamps of `now`."""
    return converted_offset(float(state.values[sensor, "time_offset"][0]), sensor, before, now)


def offset_of_each_clock(
    inputs: Inputs, sensor: str, find: Callable[[int], float], known: Mapping[int, float] | None = None
) -> np.ndarray:
    """(R,) time offsets [s] of a clock that restarts, one for each recording. find(k): the offset of recording k alone;
    it is not called for recordings in `known`."""
    offsets = dict(known or {})
    for k in range(len(inputs.parts)):
        if k not in offsets:
            with naming_recording(inputs, k):
                offsets[k] = find(k)
    return np.array(
        [converted_offset(offsets[k], sensor, single_recording(inputs, k), inputs) for k in range(len(inputs.parts))]
    )
