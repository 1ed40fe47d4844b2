"""Initial guess from pose sensors: the IMU trajectory, extrinsics, and the frame of absolute poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from icalib.data.measurements import Measurements, PoseStream
from icalib.errors import EstimationError
from icalib.estimate.estimate import first_pass
from icalib.estimate.inputs import Inputs
from icalib.estimate.problem import keyframe_times, keyframes_for, start_values
from icalib.geometry import so3
from icalib.initialize.initializer import (
    BY_POSES,
    BodyTrajectory,
    FailedEstimate,
    InitialGuess,
    Initializer,
    InputsWithMotion,
    KnownExtrinsics,
    MotionSource,
    SmoothMotion,
    Values,
    fullest_recording,
    has_guesses,
    known_extrinsics,
    merged_values,
    naming_recording,
    offset_of_each_clock,
    single_recording,
    state_of_recording,
    stated_values,
    states_from_best,
)
from icalib.initialize.lever_arm import TARGET_SIZE_TOLERANCE, scale_by_accelerometer
from icalib.initialize.rate_alignment import RateAlignment
from icalib.initialize.rate_correlation import GyroRotation, SensorRates
from icalib.initialize.smooth_trajectory import BodyPoses, smooth_trajectory
from icalib.initialize.trajectories import (
    TRAJECTORY_GRAVITY_TOLERANCE,
    ExtrinsicsGuess,
    LeverArmRows,
    SensorTrajectory,
    TrajectoryFit,
    align_trajectory,
    extrinsics_on_trajectory,
    fit_imu_trajectory,
    imu_poses_at,
    system_from_readings,
    system_from_trajectory,
    too_few_poses,
    trajectory_rates,
)
from icalib.model.sensor_model import FRAME, frame_of
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import instants
from icalib.optim.state import Key, State
from icalib.rig import PoseSensor, Rig
from icalib.sensors.pose.initialize.conventions import (
    conventions,
    is_unstated,
    other_axes,
    rotation_of_positions,
    unstated,
    with_checked_convention,
)
from icalib.sensors.pose.initialize.stop_and_go import is_stop_and_go, state_from_pairs
from icalib.sensors.sensor import MOUNTED_NAMES


class PoseInitializer(Initializer[PoseSensor]):
    """The first pose sensor gives the trajectory if neither cameras nor LiDARs give it. All other pose sensors are
    aligned to the trajectory."""

    def motion_source(self, rig: Rig) -> MotionSource | None:
        return MotionSource(BY_POSES, (rig.poses[0].name,)) if rig.poses else None

    def trajectory(self, inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> State:
        return state_from_poses(inputs)

    def refined(self, inputs: Inputs, source_inputs: Inputs, state: State) -> InitialGuess:
        """State after one pass of the estimator, and extrinsics that are aligned to this improved trajectory."""
        alone, sensors = source_inputs, source_inputs.rig.poses
        state = first_pass(alone, replace(state, values=state.values | self.place(alone, state, sensors)))
        state = replace(state, values=state.values | self.place(alone, state, sensors))
        return inputs, state, state.values

    def place(self, inputs: Inputs, state: State, sensors: Sequence[PoseSensor]) -> Values:
        return pose_values(inputs, state, sensors)

    def body_poses(self, rig: Rig, recordings: Sequence[Measurements]) -> BodyTrajectory:
        streams = [m.poses[0] for m in recordings]
        if is_unstated(streams[0], rig.poses[0]):
            raise unstated(streams[0])
        poses = [BodyPoses(s.seconds, s.rotation, s.position) for s in streams]
        return BodyTrajectory(poses, conventions=_rewritten(rig, recordings))

    def start_at_rest(
        self, rig: Rig, recordings: Sequence[Measurements], body_poses: Sequence[BodyPoses], values: Values
    ) -> InitialGuess | None:
        """Initial guess by hand-eye calibration from pairs of poses, if the robot stood still at each pose; else
        None."""
        if is_stop_and_go(rig, recordings, body_poses):
            return state_from_pairs(rig, recordings, body_poses, values)
        for stream in (stream for m in recordings for stream in m.poses):
            check_rate(stream)
        return None

    def longest_spacing(self, rig: Rig, recordings: Sequence[Measurements], motion: SmoothMotion) -> float:
        return motion.spacing_for_poses(*pose_noise([m.poses[0] for m in recordings]))

    def explained(self, failed: FailedEstimate) -> EstimationError | None:
        """An error that recommends kind: absolute, if relative poses fail but the same poses converge as absolute ones;
        else None."""
        rig, first = failed.rig, failed.rig.poses[0]
        if failed.converges is None or first.kind != "relative":
            return None
        if not failed.converges(rig.with_sensors(replace(first, kind="absolute"))):
            return None
        return EstimationError(
            f"{first.name}: with kind: relative its poses are too noisy to give the motion, with kind: absolute "
            "they are not; write kind: absolute if they hardly drift over the recording."
        )


INITIALIZER = PoseInitializer()


def _rewritten(rig: Rig, recordings: Sequence[Measurements]) -> Iterator[tuple[str, list[Measurements]]]:
    """The conventions of `BodyTrajectory`: those that differ in one field of the rig file, which is not the unit."""
    sensor = rig.poses[0]
    each = ([*conventions(m.poses[0], sensor), *other_axes(m.poses[0])] for m in recordings)
    for others in zip(*each, strict=True):
        if others[0].changes == 1 and "position_unit" not in "".join(others[0].fields):
            converted = [m.with_streams(x.stream) for m, x in zip(recordings, others, strict=True)]
            yield others[0].sentence(sensor.name), converted


# Initial extrinsics, time offset and frame of a pose sensor, and the IMU trajectory if no other sensor gives it.
#
# Time offset and rotation come from aligning angular rates. The lever arm comes from linear least squares with a known
# trajectory, or with the readings of the IMU.

MIN_POSE_RATE_HZ = 2.0  # lowest rate of a moving sensor, as angular rates are means between poses
FIT_STEP_S = 0.4  # between poses that test the fit, as noise dominates the motion between successive poses
# Relative error of gravity: up to it the scale of positions may be wrong, above it the accelerometer's unit is
MAX_GRAVITY_ERROR = 0.5


def pose_values(inputs: Inputs, state: State, sensors: Sequence[PoseSensor]) -> dict[Key, np.ndarray]:
    """Initial parameters of `sensors` and of their frames, from the rig file, or by alignment to the trajectory in
    `state`.

    Raises EstimationError if a recording does not determine them.
    """
    assert inputs.imu is not None
    out: dict[Key, np.ndarray] = {}
    for sensor in sensors:
        stream = inputs.stream(sensor.name)
        assert isinstance(stream, PoseStream)
        known = stated_values(inputs, sensor)
        if len(known) < len(MOUNTED_NAMES):
            known = merged_values(sensor, known, _aligned_values(inputs, state, sensor, stream))
        elif has_guesses(sensor, known):
            with suppress(EstimationError):
                known = merged_values(sensor, known, _aligned_values(inputs, state, sensor, stream))
        out |= known | _frames(inputs.imu, sensor, stream, state, known) | {(sensor.name, "scale"): np.ones(1)}
    return out


def _aligned_values(inputs: Inputs, state: State, sensor: PoseSensor, stream: PoseStream) -> dict[Key, np.ndarray]:
    """Extrinsics and time offsets of a sensor, given the trajectory in `state`. If its clock restarts with each
    recording, the extrinsics come from the recording with most poses."""
    assert inputs.imu is not None
    extrinsics = known_extrinsics(inputs, sensor)
    if not sensor.clock_restarts:
        known = {"known": state, "extrinsics": extrinsics}
        rotation_of = partial(_position_rotation_on_trajectory, inputs.imu, **known)
        place = partial(_fit_to_trajectory, inputs.imu, **known)
        return with_checked_convention(stream, sensor, place, rotation_of).values(sensor.name)
    streams = [_imu_and_poses(inputs, k, sensor.name) for k in range(len(inputs.parts))]
    k = fullest_recording(inputs, sensor.name)
    imu, poses = streams[k]
    with naming_recording(inputs, k):
        known = {"known": state_of_recording(inputs, k, state), "extrinsics": extrinsics}
        rotation_of = partial(_position_rotation_on_trajectory, imu, **known)
        guess = with_checked_convention(poses, sensor, partial(_fit_to_trajectory, imu, **known), rotation_of)

    def offset(recording: int) -> float:
        return _aligned(*streams[recording], KnownExtrinsics(guess.rotation))[0].offset

    offsets = offset_of_each_clock(inputs, sensor.name, offset, {k: guess.offset})
    return guess.values(sensor.name) | {(sensor.name, "time_offset"): offsets}


def _imu_and_poses(inputs: Inputs, recording: int, sensor: str) -> tuple[ImuData, PoseStream]:
    """Readings of the IMU, and poses of a sensor, in one recording."""
    single = single_recording(inputs, recording)
    stream = single.stream(sensor)
    assert single.imu is not None and isinstance(stream, PoseStream)
    return single.imu, stream


def state_from_poses(inputs: Inputs) -> State:
    """The initial state from the first pose sensor and the IMU. The recording with most poses gives the extrinsics.

    Raises EstimationError if a recording does not determine the trajectory.
    """
    sensor = inputs.rig.poses[0]
    return states_from_best(inputs, sensor, fullest_recording(inputs, sensor.name), _single_state)


def _single_state(inputs: Inputs, extrinsics: KnownExtrinsics | None) -> State:
    """The initial state of one recording. extrinsics: those known of the sensor from another recording,
    or None."""
    assert inputs.imu is not None
    sensor, stream, imu, gravity = inputs.rig.poses[0], inputs.measurements.poses[0], inputs.imu, inputs.rig.gravity
    known = extrinsics or known_extrinsics(inputs, sensor)
    fit = with_checked_convention(
        stream,
        sensor,
        lambda x: _fit_to_imu(imu, x, gravity, known),
        lambda x: _position_rotation_by_imu(imu, x, known),
    )
    mounted = merged_values(sensor, stated_values(inputs, sensor), fit.guess.values(sensor.name))
    values = start_values(inputs, mounted)
    hosts = {(x.name, "time_offset"): values[sensor.name, "time_offset"] for x in inputs.rig.poses}
    keyframes = keyframes_for(inputs, keyframe_times(inputs, hosts))
    rotation, position, velocity = fit.motion.at(keyframes)
    return State(keyframes, rotation, position, velocity, np.tile(fit.motion.bias, (len(keyframes), 1)), values)


def pose_rates(stream: PoseStream) -> SensorRates:
    """Mean angular rates between successive poses; see `trajectory_rates`."""
    return trajectory_rates(stream.name, _trajectory(stream))


def check_rate(stream: PoseStream) -> None:
    """Raise EstimationError if the rate of poses is too low for angular rates."""
    rate = 1.0 / float(np.median(np.diff(stream.seconds)))
    if rate < MIN_POSE_RATE_HZ:
        often = f"{rate:.2g} pose{'' if round(rate, 1) == 1.0 else 's'} per second, but {MIN_POSE_RATE_HZ:g} are needed"
        raise EstimationError(
            f"{stream.name}: {often} during motion; record at a higher rate, or without an IMU stand still at "
            "each pose, with an image or another pose of the same stamp."
        )


def _trajectory(stream: PoseStream) -> SensorTrajectory:
    """The poses as a trajectory."""
    return SensorTrajectory(
        stream.seconds, stream.rotation, stream.position, np.ones(len(stream.stamps_ns), dtype=bool)
    )


def _aligned(imu: ImuData, stream: PoseStream, extrinsics: KnownExtrinsics) -> tuple[RateAlignment, SensorRates]:
    """Alignment of the sensor's angular rates with the gyroscope, and these rates. extrinsics: those known."""
    rates = pose_rates(stream)
    return align_trajectory(imu, stream.name, rates, extrinsics), rates


def _fit_to_imu(
    imu: ImuData, stream: PoseStream, gravity: float, extrinsics: KnownExtrinsics
) -> tuple[TrajectoryFit, float]:
    """Extrinsics and IMU trajectory from poses and IMU, and the share of the motion that they do not explain. Raises
    EstimationError if poses and IMU contradict each other, or poses are too few."""
    aligned, rates = _aligned(imu, stream, extrinsics)
    trajectory, t = _trajectory(stream), stream.seconds + aligned.offset
    trajectory = trajectory.only((t > imu.seconds[0]) & (t < imu.seconds[-1]))
    gyro, R_is = GyroRotation.integrate(imu, aligned.gyro_bias), aligned.rotation
    trajectory = replace(
        trajectory, rotation=gyro.smoothed(trajectory.seconds + aligned.offset, trajectory.rotation @ R_is.T) @ R_is
    )
    fit = fit_imu_trajectory(imu, trajectory, rates, aligned, gravity, extrinsics)
    if fit is None:
        raise too_few_poses(stream.name)
    off = abs(fit.gravity / gravity - 1.0)
    if off <= MAX_GRAVITY_ERROR:
        _check_scale(imu, stream.name, trajectory, aligned, fit)
    if off > TRAJECTORY_GRAVITY_TOLERANCE:
        raise EstimationError(
            f"{imu.name} and {stream.name} together give a gravity of {fit.gravity:.3g} m/s^2 instead of "
            f"{gravity:.3g}; check that the accelerometer is in m/s^2, not in g (accel_unit), and the "
            f"positions of {stream.name} in metres."
        )
    step = max(1, round(FIT_STEP_S / float(np.median(np.diff(trajectory.seconds)))))
    apart = fit_imu_trajectory(
        imu, trajectory.only(np.arange(len(trajectory.seconds)) % step == 0), rates, aligned, gravity, extrinsics
    )
    return fit, (fit if apart is None else apart).unexplained


def _position_rotation_by_imu(imu: ImuData, stream: PoseStream, extrinsics: KnownExtrinsics) -> np.ndarray | None:
    """`rotation_of_positions` with the readings of the IMU as reference."""
    aligned, _ = _aligned(imu, stream, extrinsics)
    trajectory, t = _trajectory(stream), stream.seconds + aligned.offset
    trajectory = trajectory.only((t > imu.seconds[0]) & (t < imu.seconds[-1]))
    carry = partial(
        GyroRotation.integrate(imu, aligned.gyro_bias).carry, trajectory.seconds + aligned.offset, to=imu.seconds
    )
    system = system_from_readings(
        imu, carry, trajectory.seconds + aligned.offset, trajectory.rotation, trajectory.position
    )
    return rotation_of_positions(system(aligned.rotation, np.zeros(3)))


def _position_rotation_on_trajectory(
    imu: ImuData, stream: PoseStream, known: State, extrinsics: KnownExtrinsics
) -> np.ndarray | None:
    """`rotation_of_positions` with the trajectory `known` as reference."""
    aligned, _ = _aligned(imu, stream, extrinsics)
    trajectory, t = _trajectory(stream), stream.seconds + aligned.offset
    trajectory = trajectory.only((t >= known.seconds[0]) & (t <= known.seconds[-1]))
    t = trajectory.seconds + aligned.offset
    if not len(t):
        return None
    R, p = imu_poses_at(known, GyroRotation.integrate(imu, known.bias[:, :3].mean(axis=0)), t)
    U, _, Vt = np.linalg.svd((R @ aligned.rotation @ trajectory.rotation.transpose(0, 2, 1)).sum(axis=0))
    rows = system_from_trajectory(R, p, t, trajectory.rotation, trajectory.position)(aligned.rotation, np.zeros(3))
    return rotation_of_positions(rows, U @ Vt)


def _check_scale(
    imu: ImuData, name: str, trajectory: SensorTrajectory, aligned: RateAlignment, fit: TrajectoryFit
) -> None:
    """Raise EstimationError if the accelerometer contradicts the scale of positions. The scale is estimated together
    with the lever arm; see `scale_by_accelerometer`."""
    gyro, t = GyroRotation.integrate(imu, aligned.gyro_bias), trajectory.seconds + aligned.offset

    def rows_at(position: np.ndarray) -> LeverArmRows:
        """Equations of lever arm, gravity and accelerometer bias, as if the sensor had measured `position` (n, 3)."""
        carry = partial(gyro.carry, t, to=imu.seconds)
        return system_from_readings(imu, carry, t, trajectory.rotation, position)(
            fit.guess.rotation, fit.guess.position
        )

    rows, from_imu = rows_at(trajectory.position), -rows_at(np.zeros_like(trajectory.position)).b
    scale, std = scale_by_accelerometer(rows.A[:, :, 3:], rows.b, from_imu)
    if abs(scale - 1.0) > max(TARGET_SIZE_TOLERANCE, 5.0 * std):
        raise EstimationError(
            f"{name}: the accelerometer shows its motion to be {scale:.2f} +- {std:.2f} times as large as its "
            "positions; these must be in metres (an odometry from one camera has no scale)."
        )


def _fit_to_trajectory(
    imu: ImuData, stream: PoseStream, known: State, extrinsics: KnownExtrinsics
) -> tuple[ExtrinsicsGuess, float]:
    """`extrinsics_on_trajectory` for a stream of poses."""
    return extrinsics_on_trajectory(imu, stream.name, _trajectory(stream), known, extrinsics)


def _frames(
    imu: ImuData, sensor: PoseSensor, stream: PoseStream, known: State, values: dict[Key, np.ndarray]
) -> dict[Key, np.ndarray]:
    """Pose of the frame of absolute poses in the world, by recording: chordal mean of the rotations and median of the
    origins over all poses. Raises EstimationError without poses in a recording."""
    out: dict[Key, np.ndarray] = {}
    R_is, p_is, _ = (values[sensor.name, name] for name in MOUNTED_NAMES)
    t = instants(stream, values)
    for k, keyframes in enumerate(known.recordings if sensor.kind == "absolute" else ()):
        part = _keyframes(known, keyframes)
        rows = np.flatnonzero((t >= part.seconds[0]) & (t <= part.seconds[-1]))
        if not len(rows):
            raise too_few_poses(stream.name)
        R, p = imu_poses_at(part, GyroRotation.integrate(imu, part.bias[:, :3].mean(axis=0)), t[rows])
        R_wf = so3.closest_rotation((R @ R_is @ stream.rotation[rows].transpose(0, 2, 1)).sum(axis=0))
        origin = np.median(p + R @ p_is - stream.position[rows] @ R_wf.T, axis=0)
        frame = frame_of(sensor.name, k)
        out |= {(frame, FRAME[0]): R_wf, (frame, FRAME[1]): origin}
    return out


def _keyframes(state: State, keyframes: slice) -> State:
    """The state with only a slice of its keyframes, as one recording."""
    columns = {
        name: getattr(state, name)[keyframes] for name in ("seconds", "rotation", "position", "velocity", "bias")
    }
    return replace(state, **columns, starts=(0,))


# Initial noise of poses, before any estimation.

MAD_TO_SIGMA = 1.4826  # ratio of the standard deviation of normal noise to its median absolute value


def pose_noise(streams: Sequence[PoseStream]) -> tuple[float, float]:
    """Standard deviations of rotation [rad] and position [m] from a smooth trajectory, each for the noisiest axis."""
    rotations, offsets = [], []
    for s in streams:
        smooth = smooth_trajectory(s.seconds, s.rotation, s.position, s.seconds, narrow=True)
        rotations.append(so3.log_many(np.ascontiguousarray(smooth.rotation.transpose(0, 2, 1) @ s.rotation)))
        offsets.append(s.position - smooth.position)
    rotation, position = (
        MAD_TO_SIGMA * np.median(np.abs(np.concatenate(x)), axis=0).max() for x in (rotations, offsets)
    )
    return float(rotation), float(position)
