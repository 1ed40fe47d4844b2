"""Without an IMU, but with wheels or a pose sensor: smooth motion is assumed in its place.

The estimate keeps an IMU that reads zero and knows no gravity. The biases of a keyframe are then minus its angular rate
and minus its acceleration, in the axes of the body. Their random walk is white noise on angular acceleration and on
jerk: a motion prior, which ties keyframes and propagates poses from keyframes to the instants of sensors. Its densities
are those of the motion itself, as the poses of the body show it. Nothing else is taken from these twice.

The body is the first camera, whose target is the world, or the first pose sensor, whose frame is. Cameras with feature
tracks are placed on the motion of the pose sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from icalib.data.measurements import ImuStream, Measurements
from icalib.errors import EstimationError
from icalib.estimate.problem.assembly import keyframe_times, keyframes_for, start_values
from icalib.estimate.problem.inputs import Inputs, inputs_for
from icalib.geometry.targets.base import BOARD
from icalib.initialize.cameras_on_odometry import (
    camera_poses,
    pose_streams,
    relative_to_first_camera,
    with_pose_sensor,
    with_stated_values,
)
from icalib.initialize.steps.contradicted_guesses import MotionContradictedError
from icalib.initialize.steps.initializer import (
    Initializer,
    Values,
    initializer_of,
    kinds_of,
    motion_kinds,
    place_sensors,
)
from icalib.initialize.steps.keyframe_spacing import SmoothMotion
from icalib.initialize.steps.rig_file_values import stated_values
from icalib.initialize.steps.smooth_trajectory import MIN_PARABOLA_POSES, BodyPoses, SmoothTrajectory
from icalib.model.frames import FRAME, frame_of
from icalib.motion.keyframe_placement import first_keyframes
from icalib.optim.state import State, in_recording
from icalib.rig import ImuNoise, ImuSensor, Rig, Sensor
from icalib.sensors.parameter import Parameter, fixed
from icalib.sensors.sensor import mounted

ASSUMED_IMU = "assumed motion"  # the name of the IMU; no sensor is called so
ASSUMED_IMU_STEP_S = 0.01  # between its readings
REGULARISING_STEP_S = 5e-3  # its white noise is what the walks make of so long a step: keeps covariances regular
DENSITY_LAG_S = 0.1  # over which changes of rate and acceleration tell their densities
MIN_DENSITY = 1e-3  # rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz): of a body that stood still
MIN_KEYFRAME_SPACING_S = 0.02  # of keyframes: the same as with an IMU


InitialGuess = tuple[Inputs, State, Values]


def guess_with_assumed_motion(rig: Rig, recordings: Sequence[Measurements]) -> InitialGuess:
    """As `start.start`. Where all was measured at rest, no motion is assumed.

    Raises EstimationError where the poses of the body do not show its motion, or are in another convention, or where
    other sensors are not aligned with it.
    """
    try:
        return _guess(rig, recordings)
    except MotionContradictedError as error:
        for words, others in motion_kinds(rig)[0].rewritten(recordings):
            try:
                _guess(rig, others)
            except EstimationError:
                continue
            raise EstimationError(words) from error
        raise


def _guess(rig: Rig, recordings: Sequence[Measurements]) -> InitialGuess:
    """As `start_without_imu`, with poses as they are written."""
    shown = _BodyMotion.by(motion_kinds(rig)[0], rig, recordings)
    for kind in kinds_of(rig):
        if (still := kind.start_at_rest(rig, recordings, shown.body, shown.values)) is not None:
            return still
    for m in recordings:
        for kind in kinds_of(rig):
            kind.check_moving(m)
    for own, m in zip(shown.body, recordings, strict=True):
        if len(own.seconds) < MIN_PARABOLA_POSES:
            where = f"{m.name}: " if len(recordings) > 1 else ""
            raise EstimationError(
                f"{where}{rig.reference} has a pose at only {len(own.seconds)} instants; record more."
            )
    paths = _smoothed(shown.body)
    # Densities come out too large rather than too small: a wide window would take motion from them.
    body = _with_assumption(rig, recordings, _smoothed(shown.body, narrow=True))
    inputs = replace(inputs_for(body, _with_assumed_readings(recordings, paths, rig.settings.max_gap_s)), asked=rig)
    felt = _with_ideal_readings(body, recordings, paths, inputs)
    found = shown.values if shown.reckoned is None else with_stated_values(inputs, shown.reckoned, shown.values)
    if _keyframe_hosts(body) and not found:
        found = _place_hosts(body, recordings, shown.body, paths)
    moving, turned = _keyframe_motion(inputs, shown.body, found)
    others = [s for s in body.mounted if (s.name, "rotation") not in moving.values]
    values = place_sensors(felt, moving, others) | moving.values
    return inputs, replace(moving, bias=-turned, values=values), values


@dataclass(frozen=True)
class _BodyMotion:
    """Poses of the body in each recording; values found on the way; reckoned: the sensor whose dead reckoning showed
    them."""

    body: list[BodyPoses]
    values: Values
    reckoned: str | None = None

    @classmethod
    def by(cls, source: Initializer[Any], rig: Rig, recordings: Sequence[Measurements]) -> _BodyMotion:
        """The poses of the body by the sensors of `source`, which may not be the body."""
        paths, found = source.body_poses(rig, recordings)
        if initializer_of(rig.sensors[rig.reference]) is source:
            return cls(paths, found)
        (name,) = source.sources(rig)
        values = _place_cameras(rig, recordings, name, paths)
        return cls(
            camera_poses(rig, recordings, name, paths, values), relative_to_first_camera(rig, name, values), name
        )


def _smoothed(body: Sequence[BodyPoses], narrow: bool = False) -> list[SmoothTrajectory]:
    """The path of the body in each recording, every STEP_S from its first stamp on."""
    return [own.at(np.arange(0.0, own.seconds[-1], ASSUMED_IMU_STEP_S), narrow=narrow) for own in body]


def _keyframe_hosts(rig: Rig) -> list[Sensor]:
    """The sensors at whose measurements keyframes lie, but for the body."""
    return [s for s in rig.mounted if initializer_of(s).hosts_keyframes and s.name != rig.reference_without_imu]


def _place_hosts(
    body: Rig, recordings: Sequence[Measurements], shown: Sequence[BodyPoses], paths: Sequence[SmoothTrajectory]
) -> Values:
    """The sensors that host keyframes, placed on the motion that the first pose sensor of `body` shows."""
    hosts = _keyframe_hosts(body)
    blind = body.without(*(s.name for s in hosts))
    unseen = [m.only(*blind.sensors) for m in recordings]
    alone = _with_ideal_readings(blind, unseen, paths, inputs_for(blind, _with_assumed_readings(unseen, paths)))
    felt = _with_ideal_readings(body, recordings, paths, inputs_for(body, _with_assumed_readings(recordings, paths)))
    return place_sensors(felt, _keyframe_motion(alone, shown, {})[0], hosts)


def _place_cameras(rig: Rig, recordings: Sequence[Measurements], sensor: str, paths: Sequence[BodyPoses]) -> Values:
    """Cameras with feature tracks, placed on the planar `paths` of `sensor`, on which nothing else is known."""
    blank = with_pose_sensor(rig, sensor)
    streams = pose_streams(recordings, sensor, paths)
    posed = [m.only(*(c.name for c in rig.cameras)).with_streams(s) for m, s in zip(recordings, streams, strict=True)]
    smooth = _smoothed(paths)
    try:
        return _place_hosts(_with_assumption(blank, posed, smooth), posed, paths, smooth)
    except EstimationError as error:
        said = str(error).rstrip(".")
        raise EstimationError(
            f"{said}. Without IMU, target and pose sensor, {sensor} determines the motion on a flat floor only."
        ) from error


def _with_ideal_readings(
    rig: Rig, recordings: Sequence[Measurements], paths: Sequence[SmoothTrajectory], like: Inputs
) -> Inputs:
    """The inputs with the readings that an IMU in the body would have."""
    felt = inputs_for(rig, _with_assumed_readings(recordings, paths), like)
    assert felt.imu is not None
    return replace(felt, imu=replace(felt.imu, forwards=False))


def _keyframe_motion(inputs: Inputs, shown: Sequence[BodyPoses], found: Values) -> tuple[State, np.ndarray]:
    """The motion of the body without biases, and its angular rate and acceleration (K, 6) at keyframes; `found`: what
    is known of sensors."""
    values = start_values(inputs, found | _body_identities(inputs))
    keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
    starts = first_keyframes(inputs.imu, keyframes)
    parts = np.split(keyframes, starts[1:])
    ways = [own.at(t - part.begin) for own, t, part in zip(shown, parts, inputs.parts, strict=True)]
    R, p, v, rate, force = (
        np.concatenate([getattr(w, name) for w in ways])
        for name in ("rotation", "position", "velocity", "rate", "acceleration")
    )
    still = np.zeros((len(keyframes), 6))
    return State(keyframes, R, p, v, still, values, starts), np.concatenate([rate, force], axis=1)


def _with_assumption(rig: Rig, recordings: Sequence[Measurements], paths: Sequence[SmoothTrajectory]) -> Rig:
    """The rig with the assumption as its IMU, which is where the body is."""
    turning, jerking = (
        np.sqrt(np.mean(np.concatenate([_changes_over_lag(p, what) for p in paths]) ** 2) / DENSITY_LAG_S) + MIN_DENSITY
        for what in ("rate", "acceleration")
    )
    noise = ImuNoise(REGULARISING_STEP_S * turning, turning, REGULARISING_STEP_S * jerking, jerking, ASSUMED_IMU)
    here = mounted(fixed(np.eye(3)), fixed(np.zeros(3)), fixed(np.zeros(1)))
    imu = ImuSensor(ASSUMED_IMU, "", noise, Parameter("fixed"), assumed=True)
    if not motion_kinds(rig)[0].hosts_keyframes:
        motion = SmoothMotion(paths, float(turning), float(jerking))
        imu = replace(imu, pose_keyframes_s=keyframe_spacing(rig, recordings, motion))
    return rig.with_sensors(imu, replace(rig.sensors[rig.reference], **here), gravity=0.0)


def keyframe_spacing(rig: Rig, recordings: Sequence[Measurements], motion: SmoothMotion) -> float:
    """Seconds, from LEAST_SPACING_S to the rig's `keyframe_spacing_s`: the largest that all kinds of sensors allow."""
    longest = min(kind.longest_spacing(rig, recordings, motion) for kind in kinds_of(rig))
    return float(np.clip(longest, MIN_KEYFRAME_SPACING_S, max(rig.settings.keyframe_spacing_s, MIN_KEYFRAME_SPACING_S)))


def _changes_over_lag(path: SmoothTrajectory, what: str) -> np.ndarray:
    """(n, 3) over LAG_S, where poses show both ends."""
    n = round(DENSITY_LAG_S / ASSUMED_IMU_STEP_S)
    x = getattr(path, what)
    return (x[n:] - x[:-n])[path.near[n:] & path.near[:-n]]


def _with_assumed_readings(
    recordings: Sequence[Measurements], paths: Sequence[SmoothTrajectory], max_gap_s: float | None = None
) -> list[Measurements]:
    """The recordings with readings of the assumed IMU: zero, but in gaps of poses that are longer than `max_gap_s`; or
    without it those that an IMU in the body would have, where poses show them."""
    out = []
    for m, path in zip(recordings, paths, strict=True):
        stamps = m.origin_ns + np.round(path.seconds * 1e9).astype(np.int64)
        used = path.near.copy() if max_gap_s is None else _within_short_gaps(path, max_gap_s)
        used[:1] = True  # its clock begins where the body's does
        gyro, accel = (x[used] * float(max_gap_s is None) for x in (path.rate, path.acceleration))
        out.append(m.with_streams(ImuStream(ASSUMED_IMU, stamps[used], gyro, accel)))
    return out


def _within_short_gaps(path: SmoothTrajectory, max_gap_s: float) -> np.ndarray:
    """(m,) whether poses show the path, or it is unseen for a short while only: for longer an assumption says nothing
    of where the body is."""
    seen = path.seconds[path.near]
    if not len(seen):
        return np.zeros(len(path.seconds), dtype=bool)
    after, ends = np.searchsorted(seen, path.seconds), np.concatenate([[-np.inf], seen, [np.inf]])
    before, behind = ends[after], ends[after + 1]
    return path.near | (behind - before <= max_gap_s)


def _body_identities(inputs: Inputs) -> Values:
    """The body is where the assumed IMU is, and its target or its frame is the world."""
    sensor = inputs.rig.sensors[inputs.rig.reference_without_imu]
    out, own = stated_values(inputs, sensor), {block.key for block in inputs.layout.blocks}
    for k in range(len(inputs.parts)):
        frame = frame_of(sensor.name, k)
        world = {
            (in_recording(BOARD, k), "tilt"): np.eye(3),
            (frame, FRAME[0]): np.eye(3),
            (frame, FRAME[1]): np.zeros(3),
        }
        out |= {key: value for key, value in world.items() if key in own}
    return out
