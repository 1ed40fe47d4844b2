"""Assumes smooth motion in place of an IMU, for a rig with wheels or a pose sensor.

The estimate gets an IMU that reads zero, without gravity. Its biases at a keyframe are then minus the body's angular
rate and minus its acceleration, in body axes. The random walk of the biases is white noise on angular acceleration and
jerk: a motion prior that connects keyframes and propagates poses to the instants of measurements. Its densities are
estimated from the poses of the body; nothing else is taken from the measurements twice.

The body is the first camera or the first pose sensor, or else the wheels. The world is the frame of the camera's
target or of the pose sensor's poses, or a flat floor. Cameras with feature tracks are aligned to the
trajectory of the pose sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import ImuStream, Measurements, PoseStream, streams_of_rig
from icalib.errors import EstimationError
from icalib.estimate.inputs import Inputs, inputs_for
from icalib.estimate.problem import keyframe_times, keyframes_for, start_values
from icalib.geometry.targets.base import BOARD
from icalib.initialize.initializer import (
    BodyTrajectory,
    InitialGuess,
    MotionContradictedError,
    SmoothMotion,
    Values,
    initializer_of,
    keyframe_hosts,
    kinds_of,
    merged_values,
    motion_kinds,
    place_sensors,
    sources_of,
    stated_values,
)
from icalib.initialize.smooth_trajectory import MIN_PARABOLA_POSES, BodyPoses, SmoothTrajectory
from icalib.model.sensor_model import FRAME, frame_of
from icalib.motion.poses import first_keyframes
from icalib.optim.state import State, in_recording
from icalib.rig import ImuNoise, ImuSensor, Parameter, PoseSensor, Rig, Sensor
from icalib.sensors.parameter import fixed
from icalib.sensors.sensor import MOUNTED_NAMES, mounted
from icalib.sensors.stream import Stream

SLOW_HZ = 10.0  # rate of poses below which motion by hand may change direction between two of them
ASSUMED_IMU_STEP_S = 0.01  # s between its readings
DENSITY_LAG_S = 0.1  # s: lag over which changes of rate and acceleration are compared to estimate their densities
MIN_DENSITY = 1e-3  # rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz): floor for a body at rest
REWEIGHTINGS = 10  # of these changes by their noise; twice as many change the density by less than 1 %
MIN_KEYFRAME_SPACING_S = 0.02  # s between keyframes, as with an IMU


def guess_with_assumed_motion(rig: Rig, recordings: Sequence[Measurements]) -> InitialGuess:
    """As `rig_guess.guess_of_rig`, for a rig without IMU. If all was measured at rest, no motion is assumed.

    Raises EstimationError if the body's poses do not show its motion, are in another convention, or if other sensors do
    not align to it.
    """
    source, trajectory = motion_kinds(rig)[0], None
    try:
        trajectory = source.body_poses(rig, recordings)
        return _guess(*_led_by(trajectory.reference, rig, recordings), trajectory)
    except EstimationError as error:
        contradicted = trajectory if isinstance(error, MotionContradictedError) else None
        for words, converted in contradicted.conventions if contradicted else ():
            try:
                _guess(rig, converted, source.body_poses(rig, converted))
            except EstimationError:
                continue
            raise EstimationError(words) from error
        if ASSUMED_IMU in str(error):
            body = next(s for s in recordings[0].streams.values() if s.name == rig.reference)
            error.args = (_with_rate(str(error), body),)
        raise


def _led_by(reference: str, rig: Rig, recordings: Sequence[Measurements]) -> tuple[Rig, Sequence[Measurements]]:
    """The rig with another reference, if one is given, and its recordings. Poses stay in the frame of the body."""
    if not reference:
        return rig, recordings
    led = replace(rig, sensors={reference: rig.sensors[reference], **rig.sensors}, body=rig.body or rig.reference)
    note = Remark(
        "motion_by_other_sensor",
        f"{reference} shows the motion better than {rig.reference}, so time offsets refer to the clock of {reference}.",
    )
    first, *others = (streams_of_rig(led, m) for m in recordings)
    return led, [replace(first, notes=(*first.notes, note)), *others]


def _with_rate(sentence: str, body: Stream) -> str:
    """The sentence of an error, with the sensor that shows the motion and its rate in place of the assumed IMU."""
    rate = 1.0 / float(np.median(np.diff(body.seconds)))
    advice = " Record at 20 Hz, move more slowly, or add an IMU." if rate < SLOW_HZ else ""
    return sentence.replace(ASSUMED_IMU, f"{body.name} at {rate:.3g} Hz") + advice


def _guess(rig: Rig, recordings: Sequence[Measurements], trajectory: BodyTrajectory) -> InitialGuess:
    """As `guess_with_assumed_motion`, without trying other conventions of the poses. trajectory: of the source."""
    motion = _BodyMotion.by(rig, recordings, trajectory)
    for kind in kinds_of(rig):
        if (still := kind.start_at_rest(rig, recordings, motion.body, motion.values)) is not None:
            return still
    for poses, m in zip(motion.body, recordings, strict=True):
        if len(poses.seconds) < MIN_PARABOLA_POSES:
            where = f"{m.name}: " if len(recordings) > 1 else ""
            raise EstimationError(
                f"{where}{rig.reference} has a pose at only {len(poses.seconds)} instants; record more."
            )
    paths = _smoothed(motion.body)
    # The noise densities of the assumed IMU are those of the motion. A wide window would smooth away motion and
    # underestimate the densities.
    rig_with_imu = _with_assumption(rig, recordings, _smoothed(motion.body, narrow=True))
    inputs = replace(
        inputs_for(rig_with_imu, with_assumed_readings(recordings, paths, rig.settings.max_gap_s)), user_rig=rig
    )
    # The estimate gets an IMU that reads zero. Alignment needs one that reads the motion of the smoothed trajectory.
    ideal = _with_ideal_readings(rig_with_imu, recordings, paths, inputs)
    sensor_values = (
        motion.values if motion.odometry is None else with_stated_values(inputs, motion.odometry, motion.values)
    )
    # Keyframes at a sensor's measurements need its time offset, so such a sensor is aligned before keyframes exist.
    if hosts_without_body(rig_with_imu) and not sensor_values:
        sensor_values = _place_hosts(rig_with_imu, recordings, motion.body, paths)
    start, rates = _keyframe_motion(inputs, motion.body, sensor_values)
    # The biases are minus the rate and acceleration of the body, because the assumed IMU reads zero.
    unplaced = [s for s in rig_with_imu.mounted if (s.name, "rotation") not in start.values]
    values = place_sensors(ideal, start, unplaced) | start.values
    state = replace(start, bias=-rates, values=values)
    for kind in kinds_of(rig):
        inputs, state, changed = kind.associated(inputs, state)
        values = values | changed
    return inputs, state, values


@dataclass(frozen=True)
class _BodyMotion:
    """Poses of the body in each recording, and parameters `values` that were estimated with them. odometry: the sensor
    whose dead reckoning gave the poses, or None."""

    body: list[BodyPoses]
    values: Values
    odometry: str | None = None

    @classmethod
    def by(cls, rig: Rig, recordings: Sequence[Measurements], trajectory: BodyTrajectory) -> _BodyMotion:
        """Poses of the body from the `trajectory` of the sensors that show it. If the body is of another kind, all
        sensors that host keyframes are aligned to it first."""
        source, paths = motion_kinds(rig)[0], trajectory.poses
        if initializer_of(rig.sensors[rig.reference]) is source:
            return cls(paths, trajectory.values)
        (name,) = sources_of(source, rig)
        values = _place_on_odometry(rig, recordings, name, paths)
        return cls(body_poses_by(rig, recordings, name, paths, values), relative_to_body(rig, name, values), name)


def _smoothed(body: Sequence[BodyPoses], narrow: bool = False) -> list[SmoothTrajectory]:
    """The trajectory of the body in each recording, every ASSUMED_IMU_STEP_S from its first stamp. narrow: see
    `smooth_trajectory`."""
    return [poses.at(np.arange(0.0, poses.seconds[-1], ASSUMED_IMU_STEP_S), narrow=narrow) for poses in body]


def _place_hosts(
    rig: Rig, recordings: Sequence[Measurements], body_poses: Sequence[BodyPoses], paths: Sequence[SmoothTrajectory]
) -> Values:
    """Values of the sensors that host keyframes, aligned to the motion of the first pose sensor of `rig`."""
    hosts = hosts_without_body(rig)
    rig_without_hosts = rig.without(*(s.name for s in hosts))
    recordings_without_hosts = [m.only(*rig_without_hosts.sensors) for m in recordings]
    inputs = _with_ideal_readings(
        rig_without_hosts,
        recordings_without_hosts,
        paths,
        inputs_for(rig_without_hosts, with_assumed_readings(recordings_without_hosts, paths)),
    )
    ideal = _with_ideal_readings(rig, recordings, paths, inputs_for(rig, with_assumed_readings(recordings, paths)))
    return place_sensors(ideal, _keyframe_motion(inputs, body_poses, {})[0], hosts)


def _place_on_odometry(rig: Rig, recordings: Sequence[Measurements], sensor: str, paths: Sequence[BodyPoses]) -> Values:
    """Values of the sensors that host keyframes, aligned to the planar trajectories `paths` of `sensor`. Raises
    EstimationError if the motion does not determine them."""
    rig_with_poses = with_pose_sensor(rig, sensor)
    streams = pose_streams(recordings, sensor, paths)
    hosts = [s.name for s in keyframe_hosts(rig.mounted)]
    recordings_with_poses = [m.only(*hosts).with_streams(s) for m, s in zip(recordings, streams, strict=True)]
    smooth = _smoothed(paths)
    try:
        return _place_hosts(
            _with_assumption(rig_with_poses, recordings_with_poses, smooth), recordings_with_poses, paths, smooth
        )
    except EstimationError as error:
        reason = str(error).rstrip(".")
        raise EstimationError(
            f"{reason}. Without IMU, target and pose sensor, {sensor} determines the motion on a flat floor only."
        ) from error


def _with_ideal_readings(
    rig: Rig, recordings: Sequence[Measurements], paths: Sequence[SmoothTrajectory], time_base: Inputs
) -> Inputs:
    """Inputs with the readings that an ideal IMU in the body would have. time_base: inputs whose time base is kept."""
    ideal = inputs_for(rig, with_assumed_readings(recordings, paths), time_base)
    assert ideal.imu is not None
    return replace(ideal, imu=replace(ideal.imu, forwards=False))


def _keyframe_motion(
    inputs: Inputs, body_poses: Sequence[BodyPoses], sensor_values: Values
) -> tuple[State, np.ndarray]:
    """The trajectory of the body at keyframes, without biases, and its angular rate and acceleration (K, 6) there.
    sensor_values: known values of sensors."""
    values = start_values(inputs, sensor_values | _body_identities(inputs))
    keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
    starts = first_keyframes(inputs.imu, keyframes)
    parts = np.split(keyframes, starts[1:])
    trajectories = [poses.at(t - part.begin) for poses, t, part in zip(body_poses, parts, inputs.parts, strict=True)]
    R, p, v, rate, force = (
        np.concatenate([getattr(trajectory, name) for trajectory in trajectories])
        for name in ("rotation", "position", "velocity", "rate", "acceleration")
    )
    zero_bias = np.zeros((len(keyframes), 6))
    return State(keyframes, R, p, v, zero_bias, values, starts), np.concatenate([rate, force], axis=1)


def _with_assumption(rig: Rig, recordings: Sequence[Measurements], paths: Sequence[SmoothTrajectory]) -> Rig:
    """The rig with the assumed IMU, which coincides with the body. Its noise densities are those of the motion, times
    the `prior_factor` of the body."""
    turning, jerking = motion_densities(paths)
    identity = mounted(fixed(np.eye(3)), fixed(np.zeros(3)), fixed(np.zeros(1)))
    factor = initializer_of(rig.sensors[rig.reference]).prior_factor
    imu = assumed_imu(factor * turning, factor * jerking)
    settings = rig.settings
    if rig.lidars or not motion_kinds(rig)[0].hosts_keyframes:
        spacing = keyframe_spacing(rig, recordings, SmoothMotion(paths, turning, jerking))
        imu = replace(imu, pose_keyframes_s=spacing)
        if rig.lidars:  # they measure between the measurements of others, too
            settings = replace(settings, keyframe_spacing_s=spacing)
    body = replace(rig.sensors[rig.reference], **identity)
    return rig.with_sensors(imu, body, gravity=0.0, gravity_sigma=0.0, settings=settings)


def keyframe_spacing(rig: Rig, recordings: Sequence[Measurements], motion: SmoothMotion) -> float:
    """The largest spacing [s] that all kinds of sensors allow, within MIN_KEYFRAME_SPACING_S and the rig's
    `keyframe_spacing_s`."""
    longest = min(kind.longest_spacing(rig, recordings, motion) for kind in kinds_of(rig))
    return float(np.clip(longest, MIN_KEYFRAME_SPACING_S, max(rig.settings.keyframe_spacing_s, MIN_KEYFRAME_SPACING_S)))


def motion_densities(paths: Sequence[SmoothTrajectory]) -> tuple[float, float]:
    """Densities of the motion's angular acceleration [rad/s^2/sqrt(Hz)] and jerk [m/s^3/sqrt(Hz)]: RMS changes of rate
    and acceleration over DENSITY_LAG_S, between instants with poses nearby, over the root of this time.

    A squared change of acceleration is weighted by 1 / (noise + mean)^2, the inverse of its variance up to a factor
    (iteratively reweighted least squares), so that poses of a target that is hardly seen do not count. Noise is not
    subtracted: too small a density makes estimates overconfident, too large a one only less certain.
    """
    n = round(DENSITY_LAG_S / ASSUMED_IMU_STEP_S)

    def over_lag(combined: np.ufunc, field: str) -> np.ndarray:
        columns = ((getattr(p, field), p.near[n:] & p.near[:-n]) for p in paths)
        return np.concatenate([combined(x[n:], x[:-n])[near] for x, near in columns])

    turns, squares = over_lag(np.subtract, "rate") ** 2, (over_lag(np.subtract, "acceleration") ** 2).mean(axis=1)
    noise, jerks = over_lag(np.add, "acceleration_variance") + MIN_DENSITY**2 * DENSITY_LAG_S, np.mean(squares)
    for _ in range(REWEIGHTINGS):
        weight = (noise + jerks) ** -2
        jerks = weight @ squares / weight.sum()
    turning, jerking = (float(np.sqrt(x / DENSITY_LAG_S)) + MIN_DENSITY for x in (np.mean(turns), jerks))
    return turning, jerking


def _body_identities(inputs: Inputs) -> Values:
    """Identity values: the body coincides with the assumed IMU, and its target or frame with the world."""
    sensor = inputs.rig.sensors[inputs.rig.reference_without_imu]
    out, keys = stated_values(inputs, sensor), {block.key for block in inputs.layout.blocks}
    for k in range(len(inputs.parts)):
        frame = frame_of(sensor.name, k)
        world = {
            (in_recording(BOARD, k), "tilt"): np.eye(3),
            (frame, FRAME[0]): np.eye(3),
            (frame, FRAME[1]): np.zeros(3),
        }
        out |= {key: value for key, value in world.items() if key in keys}
    return out


# Sensors that stand for an assumption: an IMU for smooth motion, and a pose sensor for dead reckoning.

# Names of the assumed IMU, and of the pose sensor that stands for motion without the IMU. No sensor has a space in it.
ASSUMED_IMU, ASSUMED_POSES = "assumed motion", "assumed poses"
# s: ratio of the assumed IMU's white noise density to its random walk density; keeps covariances regular
REGULARISING_STEP_S = 5e-3


def assumed_imu(turning: float, jerking: float) -> ImuSensor:
    """The IMU that stands for smooth motion. turning, jerking: densities of the motion's angular acceleration
    [rad/s^2/sqrt(Hz)] and jerk [m/s^3/sqrt(Hz)]."""
    noise = ImuNoise(REGULARISING_STEP_S * turning, turning, REGULARISING_STEP_S * jerking, jerking, ASSUMED_IMU)
    return ImuSensor(ASSUMED_IMU, "", noise, Parameter("fixed"), assumed=True)


def with_assumed_readings(
    recordings: Sequence[Measurements], paths: Sequence[SmoothTrajectory], max_gap_s: float | None = None
) -> list[Measurements]:
    """The recordings with readings of the assumed IMU. With `max_gap_s`: zeros, except in gaps between poses that are
    longer [s]. Without: ideal readings at the instants with poses nearby."""
    out = []
    for m, path in zip(recordings, paths, strict=True):
        stamps = m.origin_ns + np.round(path.seconds * 1e9).astype(np.int64)
        used = path.near.copy() if max_gap_s is None else _within_short_gaps(path, max_gap_s)
        used[:1] = True  # its clock begins where the body's does
        gyro, accel = (x[used] * float(max_gap_s is None) for x in (path.rate, path.acceleration))
        out.append(m.with_streams(ImuStream(ASSUMED_IMU, stamps[used], gyro, accel)))
    return out


def _within_short_gaps(path: SmoothTrajectory, max_gap_s: float) -> np.ndarray:
    """(m,) whether poses are nearby, or the gap between poses is at most `max_gap_s`. Over longer gaps the assumption
    does not constrain the motion."""
    pose_s = path.seconds[path.near]
    if not len(pose_s):
        return np.zeros(len(path.seconds), dtype=bool)
    after, ends = np.searchsorted(pose_s, path.seconds), np.concatenate([[-np.inf], pose_s, [np.inf]])
    previous_s, next_s = ends[after], ends[after + 1]
    return path.near | (next_s - previous_s <= max_gap_s)


def pose_sensor_for(odometry: str) -> PoseSensor:
    """The pose sensor that stands for the sensor `odometry`."""
    return PoseSensor(odometry, "", "absolute")


def pose_streams(recordings: Sequence[Measurements], odometry: str, paths: Sequence[BodyPoses]) -> list[PoseStream]:
    """The trajectories `paths` of `odometry`, one for each recording, as measurements of a pose sensor."""
    stamps = [m.streams[odometry].stamps_ns for m in recordings]
    return [PoseStream(odometry, t, p.rotation, p.position) for t, p in zip(stamps, paths, strict=True)]


# Aligns sensors that host keyframes to a trajectory by odometry, which takes the place of a pose sensor.
#
# The body is the first of these sensors. Poses and extrinsics relative to the odometry are converted to the body.


def hosts_without_body(rig: Rig) -> list[Sensor]:
    """The sensors at whose measurements keyframes are set, without the body."""
    return [s for s in keyframe_hosts(rig.mounted) if s.name != rig.reference_without_imu]


def with_pose_sensor(rig: Rig, sensor: str) -> Rig:
    """A rig of the sensors of `rig` that host keyframes, and a pose sensor named `sensor` in place of the odometry.
    Extrinsics of the hosts are unknown."""
    free = dict.fromkeys(MOUNTED_NAMES, Parameter())
    hosts = (replace(s, clock_restarts=False, **free) for s in keyframe_hosts(rig.mounted))
    return rig.only().with_sensors(*hosts, pose_sensor_for(sensor))


def body_poses_by(
    rig: Rig, recordings: Sequence[Measurements], sensor: str, paths: Sequence[BodyPoses], values: Values
) -> list[BodyPoses]:
    """Poses of the body, on its clock, from trajectories `paths` of `sensor`. values: extrinsics and time offset of the
    body relative to `sensor`."""
    R, p, offset = (values[rig.reference, name] for name in MOUNTED_NAMES)
    between = [(m.origin_ns - m.streams[sensor].origin_ns) * 1e-9 for m in recordings]
    return [
        BodyPoses(path.seconds - offset[0] + between[0] - b, path.rotation @ R, path.position + path.rotation @ p)
        for path, b in zip(paths, between, strict=True)
    ]


def relative_to_body(rig: Rig, sensor: str, values: Values) -> Values:
    """Extrinsics and time offsets of `sensor` and of the other hosts relative to the body. `values` has those of the
    hosts relative to `sensor`. Also returns their other `values`, and the other parameters of `sensor` as the rig file
    gives them."""
    others = [s.name for s in hosts_without_body(rig)]
    R, p, offset = (values[rig.reference, name] for name in MOUNTED_NAMES)
    out = {key: value for key, value in values.items() if key[1] not in MOUNTED_NAMES}
    mounts = {sensor: (np.eye(3), np.zeros(3), np.zeros(1))}
    mounts |= {host: tuple(values[host, name] for name in MOUNTED_NAMES) for host in others}
    for name, (Q, q, dt) in mounts.items():
        out |= {(name, "rotation"): R.T @ Q, (name, "translation"): R.T @ (q - p), (name, "time_offset"): dt - offset}
    for spec in rig.sensors[sensor].specs():
        if spec.name not in MOUNTED_NAMES:
            value = getattr(rig.sensors[sensor], spec.name).value
            usual = np.full(spec.size, float(spec.is_positive))
            out[sensor, spec.name] = usual if value is None else np.asarray(value)
    return out


def with_stated_values(inputs: Inputs, sensor: str, estimates: Values) -> Values:
    """`estimates`, completed by values of the rig file for the hosts and `sensor` that do not contradict it. The height
    of `sensor` is taken from the rig file if stated, because planar motion does not show it."""
    out, rig = dict(estimates), inputs.rig
    for rig_sensor in (*hosts_without_body(rig), rig.sensors[sensor]):
        names = MOUNTED_NAMES if rig_sensor.name != sensor else [spec.name for spec in rig_sensor.specs()]
        stated, of_sensor = (
            stated_values(inputs, rig_sensor, names),
            {k: v for k, v in estimates.items() if k[0] == rig_sensor.name},
        )
        arm = sensor, "translation"
        if arm in stated and arm in of_sensor:
            up = of_sensor[sensor, "rotation"][:, 2]
            of_sensor[arm] = of_sensor[arm] + up * (up @ (stated[arm] - of_sensor[arm]))
        out |= merged_values(rig_sensor, stated, of_sensor)
    return out
