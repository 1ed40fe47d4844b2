"""Initial guess of wheels on a known trajectory: time offset, extrinsics and drive parameters."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from icalib.data.measurements import WheelPoses, WheelStream
from icalib.errors import EstimationError
from icalib.estimate.problem.assembly import motion_of
from icalib.estimate.problem.inputs import Inputs
from icalib.initialize.steps.contradicted_guesses import (
    has_guesses,
    is_contradicted,
    merged_values,
    refuse_far_off,
    stated_values,
)
from icalib.initialize.steps.initializer import possible_verticals
from icalib.initialize.steps.single_recording import offset_of_each_clock, single_recording
from icalib.motion.imu_data import clear_of
from icalib.motion.known_motion import imu_poses, is_known
from icalib.motion.time_offsets import instants
from icalib.optim.state import Key, State
from icalib.rig import Wheels
from icalib.sensors.sensor import TIME_OFFSET, TRANSLATION, mounted
from icalib.sensors.wheels.initialize.drive_guess import (
    ReversedYawError,
    WheelRates,
    drive_guess,
    wheel_offset,
    wheel_rates,
)
from icalib.sensors.wheels.initialize.relative_pose_guess import extrinsics_guess, poses_offset
from icalib.sensors.wheels.integrals import integrals_of
from icalib.sensors.wheels.spec import REVERSED_YAW

SIMPSON_WEIGHTS = np.array([1.0, 4.0, 1.0]) / 6.0  # of start, middle and end of an interval


def wheel_values(inputs: Inputs, state: State, sensors: Sequence[Wheels]) -> dict[Key, np.ndarray]:
    """Parameters of `sensors`, from the rig file or else from the trajectory in `state`.

    Raises EstimationError if the rig file lacks some and the trajectory does not determine them.
    """
    out: dict[Key, np.ndarray] = {}
    for wheels in sensors:
        stream = inputs.stream(wheels.name)
        assert isinstance(stream, (WheelStream, WheelPoses))
        out |= _wheels(inputs, state, wheels, stream)
    return out


def _wheels(inputs: Inputs, state: State, wheels: Wheels, stream: WheelStream | WheelPoses) -> dict[Key, np.ndarray]:
    """As `wheel_values`, for one set of wheels. Values of the rig file are kept unless the trajectory contradicts
    them."""
    names = [spec.name for spec in wheels.specs()]
    known = stated_values(inputs, wheels, names)
    if isinstance(stream, WheelPoses):
        known |= {(wheels.name, spec.name): np.ones(spec.size) for spec in wheels.drive_specs}
    complete = len(known) == len(names)
    if complete and isinstance(stream, WheelPoses) and not has_guesses(wheels, stated_values(inputs, wheels, names)):
        return known
    clock = wheels.name, "time_offset"
    offset = known.get(clock)
    try:
        estimated = _from_trajectory(
            inputs, state, wheels, stream, None if wheels.time_offset.mode == "free" else offset
        )
        if not complete and offset is not None and not is_contradicted(TIME_OFFSET, offset, estimated[clock]):
            estimated = _from_trajectory(inputs, state, wheels, stream, offset)
    except EstimationError:
        if complete:
            return known
        if offset is None:
            raise
        estimated = _from_trajectory(inputs, state, wheels, stream, offset)
    translation = wheels.name, "translation"
    stated = known.get(translation)
    level = estimated[translation] if stated is None else _at_height_of(inputs, state, stated, estimated[translation])
    refuse_far_off(wheels, estimated | {translation: level})
    if stated is not None and not is_contradicted(TRANSLATION, stated, level):
        estimated[translation] = stated
    return merged_values(wheels, known, estimated)


def _at_height_of(inputs: Inputs, state: State, stated: np.ndarray, lever_arm: np.ndarray) -> np.ndarray:
    """`lever_arm` (3,) m, moved along the vertical to the height of `stated` (3,), as motion on a floor
    does not determine the height."""
    up = possible_verticals(inputs, state).candidates[0]
    up = up / np.linalg.norm(up)
    return lever_arm + up * (up @ (stated - lever_arm))


def _from_trajectory(
    inputs: Inputs,
    state: State,
    wheels: Wheels,
    stream: WheelStream | WheelPoses,
    offset: np.ndarray | None,
) -> dict[Key, np.ndarray]:
    """Parameters of wheels from the trajectory; offset (1,) s: the known time offset.

    Both directions of the vertical are tried if nothing shows which is up. Raises EstimationError if neither fits.
    """
    assert inputs.imu is not None
    if isinstance(stream, WheelPoses):
        return _from_relative_poses(inputs, state, stream, offset)
    rates = wheel_rates(wheels.name, stream.seconds, integrals_of(stream), stream.kind)
    up = possible_verticals(inputs, state)
    failed: list[EstimationError] = []
    for candidate in up.candidates:
        values = _attempt(inputs, state, stream, rates, candidate, offset)
        if not isinstance(values, EstimationError):
            return values
        failed.append(values)
    other = _attempt(inputs, state, stream, rates, -up.candidates[0], offset) if up.level_sensor else failed[0]
    if not isinstance(other, EstimationError):
        raise EstimationError(
            f"{wheels.name}: {REVERSED_YAW[rates.kind]}. If z of the frame of {up.level_sensor} points down, write "
            f"level: false for {up.level_sensor} instead."
        )
    # The yaw is reversed with the wrong vertical; the cause is what fails with the other.
    raise next((error for error in (*failed, other) if not isinstance(error, ReversedYawError)), failed[0])


def _attempt(
    inputs: Inputs, state: State, stream: WheelStream, rates: WheelRates, up: np.ndarray, offset: np.ndarray | None
) -> dict[Key, np.ndarray] | EstimationError:
    """As `_from_rates`, but returns the error instead of raising it."""
    try:
        return _from_rates(inputs, state, stream, rates, up, offset)
    except EstimationError as error:
        return error


def _from_rates(
    inputs: Inputs, state: State, stream: WheelStream, rates: WheelRates, up: np.ndarray, offset: np.ndarray | None
) -> dict[Key, np.ndarray]:
    """Parameters of wheels that report rates; up (3,): the vertical in IMU axes. Raises EstimationError as
    `drive_guess`."""
    assert inputs.imu is not None
    name = stream.name
    if offset is None and inputs.sensor(name).clock_restarts:
        offset = offset_of_each_clock(inputs, name, partial(_offset_alone, inputs, name, up))
    elif offset is None:
        offset = np.array([wheel_offset(inputs.imu, up, name, rates)])
    clock = {(name, "time_offset"): offset}
    start, end = instants(stream, clock, rates.start), instants(stream, clock, rates.end)
    inside, rate, velocity = _means(inputs, state, start, end)
    drive = drive_guess(name, rates.rate[inside], rate, velocity, up, rates.kind)
    values = mounted(drive.extrinsics.R, drive.extrinsics.p, offset) | drive.values
    return {(name, group): value for group, value in values.items()}


def _offset_alone(inputs: Inputs, name: str, up: np.ndarray, recording: int) -> float:
    """Time offset [s] in one recording, relative to the first stamps of it; up (3,): the vertical in IMU axes."""
    single = single_recording(inputs, recording)
    stream = single.stream(name)
    assert single.imu is not None and isinstance(stream, WheelStream)
    return wheel_offset(single.imu, up, name, wheel_rates(name, stream.seconds, integrals_of(stream), stream.kind))


def _from_relative_poses(
    inputs: Inputs, state: State, stream: WheelPoses, offset: np.ndarray | None
) -> dict[Key, np.ndarray]:
    """Extrinsics and time offset of wheels that report relative poses."""
    assert inputs.imu is not None
    if offset is None:
        offset = np.array([poses_offset(inputs.imu, stream)])
    times = stream.seconds + offset[0]  # relative poses come from a single recording
    inside, rate, velocity = _means(inputs, state, times[:-1], times[1:])
    extrinsics = extrinsics_guess(stream, inside, rate, velocity)
    values = mounted(extrinsics.R, extrinsics.p, offset)
    return {(stream.name, name): np.ascontiguousarray(value) for name, value in values.items()}


def _means(
    inputs: Inputs, state: State, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean motion of the IMU over intervals from start to end (m,) s on its clock, by Simpson's rule.

    Returns a mask (m,) of the n intervals within the trajectory and outside gaps of the IMU; and for these the means
    (n, 3) of rate [rad/s], without bias, and velocity [m/s] in IMU axes. Raises EstimationError if there are none.
    """
    assert inputs.imu is not None
    motion = motion_of(inputs, state)
    inside = is_known(state.seconds, start) & is_known(state.seconds, end)
    inside &= clear_of(inputs.imu.gaps, start, end)  # poses in gaps are extrapolated
    if not inside.any():
        raise EstimationError(
            "no reading of the wheels falls within the recording of the other sensors; check the clocks, or "
            "time_offset in the rig file."
        )
    start, end = start[inside], end[inside]
    times = np.stack([start, 0.5 * (start + end), end], axis=1).ravel()
    poses = imu_poses(motion, times)
    velocity = np.einsum("nji,nj->ni", poses.rotation, poses.velocity)
    rate, speed = (np.einsum("k,nki->ni", SIMPSON_WEIGHTS, x.reshape(-1, 3, 3)) for x in (poses.rate, velocity))
    return inside, rate, speed
