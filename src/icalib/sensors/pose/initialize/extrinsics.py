"""A pose sensor from nothing: offset and rotation from angular rates, lever arm linearly, and where its frame stands.

It is placed on a motion that other sensors showed, or gives the motion itself, with the IMU, as a LiDAR does whose path
is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from icalib.data.measurements import PoseStream
from icalib.errors import EstimationError
from icalib.estimate.problem.assembly import keyframe_times, keyframes_for, start_values
from icalib.estimate.problem.inputs import Inputs
from icalib.geometry import so3
from icalib.initialize.steps.contradicted_guesses import has_guesses, merged_values
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.initialize.steps.lever_arm import TARGET_SIZE_TOLERANCE, scale_by_accelerometer
from icalib.initialize.steps.rate_alignment import RateAlignment
from icalib.initialize.steps.rate_correlation import SensorRates
from icalib.initialize.steps.rig_file_values import known_extrinsics, stated_values
from icalib.initialize.steps.single_recording import (
    KnownExtrinsics,
    fullest_recording,
    naming_recording,
    offset_of_each_clock,
    single_recording,
    state_of_recording,
    states_from_best,
)
from icalib.initialize.trajectories.known_trajectory import (
    extrinsics_on_trajectory,
    imu_poses_at,
    too_few_poses,
    trajectory_rates,
)
from icalib.initialize.trajectories.lever_arm_rows import LeverArmRows, system_from_readings, system_from_trajectory
from icalib.initialize.trajectories.rotation_alignment import align_trajectory
from icalib.initialize.trajectories.sensor_trajectory import ExtrinsicsGuess, SensorTrajectory
from icalib.initialize.trajectories.trajectory_fit import (
    TRAJECTORY_GRAVITY_TOLERANCE,
    TrajectoryFit,
    fit_imu_trajectory,
)
from icalib.model.frames import FRAME, frame_of
from icalib.motion.clocks import instants
from icalib.motion.imu_data import ImuData
from icalib.optim.state import Key, State
from icalib.rig import PoseSensor
from icalib.sensors.pose.initialize.conventions import placed
from icalib.sensors.pose.initialize.position_frame import turn_of_positions
from icalib.sensors.sensor import MOUNTED_NAMES

LEAST_RATE_HZ = 2.0  # of poses of something that moves
APART_S = 0.4  # of poses that show whether they fit: next to each other they differ by little but noise
G_OTHER_UNITS = 0.5  # of gravity: positions do not make it so wrong


def pose_values(inputs: Inputs, state: State, sensors: Sequence[PoseSensor]) -> dict[Key, np.ndarray]:
    """Parameters of `sensors` and of their frames, as the rig file gives them or as the motion in `state` shows them.

    Raises EstimationError where neither does.
    """
    assert inputs.imu is not None
    out: dict[Key, np.ndarray] = {}
    for sensor in sensors:
        stream = inputs.stream(sensor.name)
        assert isinstance(stream, PoseStream)
        known = stated_values(inputs, sensor)
        if len(known) < len(MOUNTED_NAMES):
            known = merged_values(sensor, known, _placed(inputs, state, sensor, stream))
        elif has_guesses(sensor, known):
            with suppress(EstimationError):
                known = merged_values(sensor, known, _placed(inputs, state, sensor, stream))
        out |= known | _frames(inputs.imu, sensor, stream, state, known) | {(sensor.name, "scale"): np.ones(1)}
    return out


def _placed(inputs: Inputs, state: State, sensor: PoseSensor, stream: PoseStream) -> dict[Key, np.ndarray]:
    """Extrinsics and time offsets of a sensor, given the motion in `state`. If its clock restarts between recordings,
    the extrinsics are those of the recording with most poses."""
    assert inputs.imu is not None
    held = known_extrinsics(inputs, sensor)
    if not sensor.clock_restarts:
        known = {"known": state, "held": held}
        turn = partial(_turn_on_motion, inputs.imu, **known)
        return placed(stream, partial(_on_motion, inputs.imu, **known), turn).values(sensor.name)
    streams = [_alone(inputs, k, sensor.name) for k in range(len(inputs.parts))]
    k = fullest_recording(inputs, sensor.name)
    imu, own = streams[k]
    with naming_recording(inputs, k):
        known = {"known": state_of_recording(inputs, k, state), "held": held}
        found = placed(own, partial(_on_motion, imu, **known), partial(_turn_on_motion, imu, **known))

    def offset(recording: int) -> float:
        return _aligned(*streams[recording], KnownExtrinsics(found.rotation))[0].offset

    offsets = offset_of_each_clock(inputs, sensor.name, offset, {k: found.offset})
    return found.values(sensor.name) | {(sensor.name, "time_offset"): offsets}


def _alone(inputs: Inputs, recording: int, sensor: str) -> tuple[ImuData, PoseStream]:
    own = single_recording(inputs, recording)
    stream = own.stream(sensor)
    assert own.imu is not None and isinstance(stream, PoseStream)
    return own.imu, stream


def state_from_poses(inputs: Inputs) -> State:
    """Where the solver starts where neither camera nor LiDAR shows the motion: the first pose sensor and the IMU do. Of
    several recordings the one with most poses says how the sensor stands.

    Raises EstimationError where they do not.
    """
    sensor = inputs.rig.poses[0]
    return states_from_best(inputs, sensor, fullest_recording(inputs, sensor.name), _state_of_one)


def _state_of_one(inputs: Inputs, held: KnownExtrinsics | None) -> State:
    """Of one recording; `held`: how the sensor stands, where another has shown it."""
    assert inputs.imu is not None
    sensor, stream, imu, gravity = inputs.rig.poses[0], inputs.measurements.poses[0], inputs.imu, inputs.rig.gravity
    known = held or known_extrinsics(inputs, sensor)
    found = placed(stream, lambda x: _with_motion(imu, x, gravity, known), lambda x: _turn_alone(imu, x, known))
    own = merged_values(sensor, stated_values(inputs, sensor), found.guess.values(sensor.name))
    values = start_values(inputs, own)
    hosts = {(x.name, "time_offset"): values[sensor.name, "time_offset"] for x in inputs.rig.poses}
    keyframes = keyframes_for(inputs, keyframe_times(inputs, hosts))
    rotation, position, velocity = found.motion.at(keyframes)
    return State(keyframes, rotation, position, velocity, np.tile(found.motion.bias, (len(keyframes), 1)), values)


def pose_rates(stream: PoseStream) -> SensorRates:
    """See `path_rates`."""
    return trajectory_rates(stream.name, _path(stream))


def check_rate(stream: PoseStream) -> None:
    """Raises EstimationError where poses are too far apart to show how it moves."""
    rate = 1.0 / float(np.median(np.diff(stream.seconds)))
    if rate < LEAST_RATE_HZ:
        often = f"{rate:.2g} pose{'' if round(rate, 1) == 1.0 else 's'} per second, but {LEAST_RATE_HZ:g} are needed"
        raise EstimationError(
            f"{stream.name}: {often} during motion; record at a higher rate, or without an IMU stand still at "
            "each pose, with an image or another pose of the same stamp."
        )


def _path(stream: PoseStream) -> SensorTrajectory:
    return SensorTrajectory(
        stream.seconds, stream.rotation, stream.position, np.ones(len(stream.stamps_ns), dtype=bool)
    )


def _aligned(imu: ImuData, stream: PoseStream, held: KnownExtrinsics) -> tuple[RateAlignment, SensorRates]:
    rates = pose_rates(stream)
    return align_trajectory(imu, stream.name, rates, held), rates


def _with_motion(
    imu: ImuData, stream: PoseStream, gravity: float, held: KnownExtrinsics
) -> tuple[TrajectoryFit, float]:
    """What the poses show with the IMU alone, and what is left of them. Raises EstimationError where they do not."""
    aligned, rates = _aligned(imu, stream, held)
    path, t = _path(stream), stream.seconds + aligned.offset
    path = path.only((t > imu.seconds[0]) & (t < imu.seconds[-1]))
    gyro, R_is = GyroRotation.integrate(imu, aligned.gyro_bias), aligned.rotation
    path = replace(path, rotation=gyro.smoothed(path.seconds + aligned.offset, path.rotation @ R_is.T) @ R_is)
    found = fit_imu_trajectory(imu, path, rates, aligned, gravity, held)
    if found is None:
        raise too_few_poses(stream.name)
    off = abs(found.gravity / gravity - 1.0)
    if off <= G_OTHER_UNITS:
        _check_size(imu, stream.name, path, aligned, found)
    if off > TRAJECTORY_GRAVITY_TOLERANCE:
        raise EstimationError(
            f"{imu.name} and {stream.name} together give a gravity of {found.gravity:.3g} m/s^2 instead of "
            f"{gravity:.3g}; check that the accelerometer is in m/s^2, not in g (accel_unit), and the "
            f"positions of {stream.name} in metres."
        )
    step = max(1, round(APART_S / float(np.median(np.diff(path.seconds)))))
    apart = fit_imu_trajectory(imu, path.only(np.arange(len(path.seconds)) % step == 0), rates, aligned, gravity, held)
    return found, 0.0 if apart is None else apart.unexplained


def _turn_alone(imu: ImuData, stream: PoseStream, held: KnownExtrinsics) -> np.ndarray | None:
    """See `turn_of_positions`: by the IMU's readings."""
    aligned, _ = _aligned(imu, stream, held)
    path, t = _path(stream), stream.seconds + aligned.offset
    path = path.only((t > imu.seconds[0]) & (t < imu.seconds[-1]))
    carry = partial(GyroRotation.integrate(imu, aligned.gyro_bias).carry, path.seconds + aligned.offset, to=imu.seconds)
    system = system_from_readings(imu, carry, path.seconds + aligned.offset, path.rotation, path.position)
    return turn_of_positions(system(aligned.rotation, np.zeros(3)))


def _turn_on_motion(imu: ImuData, stream: PoseStream, known: State, held: KnownExtrinsics) -> np.ndarray | None:
    """See `turn_of_positions`: by a motion that others showed."""
    aligned, _ = _aligned(imu, stream, held)
    path, t = _path(stream), stream.seconds + aligned.offset
    path = path.only((t >= known.seconds[0]) & (t <= known.seconds[-1]))
    t = path.seconds + aligned.offset
    if not len(t):
        return None
    R, p = imu_poses_at(known, GyroRotation.integrate(imu, known.bias[:, :3].mean(axis=0)), t)
    U, _, Vt = np.linalg.svd((R @ aligned.rotation @ path.rotation.transpose(0, 2, 1)).sum(axis=0))
    rows = system_from_trajectory(R, p, t, path.rotation, path.position)(aligned.rotation, np.zeros(3))
    return turn_of_positions(rows, U @ Vt)


def _check_size(imu: ImuData, name: str, path: SensorTrajectory, aligned: RateAlignment, found: TrajectoryFit) -> None:
    """Raises EstimationError where the accelerometer contradicts the size of the motion: the rows of `against_readings`
    with what it felt as one more column, as of a target in `lever_arm`."""
    gyro, t = GyroRotation.integrate(imu, aligned.gyro_bias), path.seconds + aligned.offset

    def rows_at(position: np.ndarray) -> LeverArmRows:
        carry = partial(gyro.carry, t, to=imu.seconds)
        return system_from_readings(imu, carry, t, path.rotation, position)(found.guess.rotation, found.guess.position)

    rows, felt = rows_at(path.position), -rows_at(np.zeros_like(path.position)).b
    size, std = scale_by_accelerometer(rows.A[:, :, 3:], rows.b, felt)
    if abs(size - 1.0) > max(TARGET_SIZE_TOLERANCE, 5.0 * std):
        raise EstimationError(
            f"{name}: the accelerometer shows its motion to be {size:.2f} +- {std:.2f} times as large as its "
            "positions; these must be in metres (an odometry from one camera has no scale)."
        )


def _on_motion(imu: ImuData, stream: PoseStream, known: State, held: KnownExtrinsics) -> tuple[ExtrinsicsGuess, float]:
    """See `path_on_motion`."""
    return extrinsics_on_trajectory(imu, stream.name, _path(stream), known, held)


def _frames(
    imu: ImuData, sensor: PoseSensor, stream: PoseStream, known: State, values: dict[Key, np.ndarray]
) -> dict[Key, np.ndarray]:
    """Where the frame of absolute poses stands in each recording's world: the mean of what the poses say."""
    out: dict[Key, np.ndarray] = {}
    R_is, p_is, _ = (values[sensor.name, name] for name in MOUNTED_NAMES)
    t = instants(stream, values)
    for k, keyframes in enumerate(known.recordings if sensor.kind == "absolute" else ()):
        part = _keyframes(known, keyframes)
        own = np.flatnonzero((t >= part.seconds[0]) & (t <= part.seconds[-1]))
        if not len(own):
            raise too_few_poses(stream.name)
        R, p = imu_poses_at(part, GyroRotation.integrate(imu, part.bias[:, :3].mean(axis=0)), t[own])
        R_wf = so3.closest_rotation((R @ R_is @ stream.rotation[own].transpose(0, 2, 1)).sum(axis=0))
        origin = np.median(p + R @ p_is - stream.position[own] @ R_wf.T, axis=0)
        frame = frame_of(sensor.name, k)
        out |= {(frame, FRAME[0]): R_wf, (frame, FRAME[1]): origin}
    return out


def _keyframes(state: State, own: slice) -> State:
    columns = {name: getattr(state, name)[own] for name in ("seconds", "rotation", "position", "velocity", "bias")}
    return replace(state, **columns, starts=(0,))
