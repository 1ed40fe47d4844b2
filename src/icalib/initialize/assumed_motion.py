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
from icalib.initialize.dead_reckoning import as_given, camera_paths, in_place_of, pose_streams, seen_from_first
from icalib.initialize.steps.contradicted import MotionContradictedError
from icalib.initialize.steps.initializer import (
    Initializer,
    Values,
    initializer_of,
    kinds_of,
    motion_kinds,
    placed,
)
from icalib.initialize.steps.keyframe_spacing import SmoothMotion
from icalib.initialize.steps.known_values import given
from icalib.initialize.steps.smooth_path import FEWEST, BodyPoses, SmoothPath
from icalib.model.frames import FRAME, frame_of
from icalib.motion.keyframe_placement import first_keyframes
from icalib.optim.state import State, in_recording
from icalib.rig import ImuNoise, ImuSensor, Rig, Sensor
from icalib.sensors.parameter import Parameter, fixed
from icalib.sensors.sensor import mounted

ASSUMPTION = "assumed motion"  # the name of the IMU; no sensor is called so
STEP_S = 0.01  # between its readings
WHITE_STEP_S = 5e-3  # its white noise is what the walks make of so long a step: keeps covariances regular
LAG_S = 0.1  # over which changes of rate and acceleration tell their densities
LEAST_DENSITY = 1e-3  # rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz): of a body that stood still
LEAST_SPACING_S = 0.02  # of keyframes: the same as with an IMU


Start = tuple[Inputs, State, Values]


def start_without_imu(rig: Rig, recordings: Sequence[Measurements]) -> Start:
    """As `start.start`. Where all was measured at rest, no motion is assumed.

    Raises EstimationError where the poses of the body do not show its motion, or are in another convention, or where
    other sensors are not aligned with it.
    """
    try:
        return _start(rig, recordings)
    except MotionContradictedError as error:
        for words, others in motion_kinds(rig)[0].rewritten(recordings):
            try:
                _start(rig, others)
            except EstimationError:
                continue
            raise EstimationError(words) from error
        raise


def _start(rig: Rig, recordings: Sequence[Measurements]) -> Start:
    """As `start_without_imu`, with poses as they are written."""
    shown = _Shown.by(motion_kinds(rig)[0], rig, recordings)
    for kind in kinds_of(rig):
        if (still := kind.start_at_rest(rig, recordings, shown.body, shown.values)) is not None:
            return still
    for m in recordings:
        for kind in kinds_of(rig):
            kind.check_moving(m)
    for own, m in zip(shown.body, recordings, strict=True):
        if len(own.seconds) < FEWEST:
            where = f"{m.name}: " if len(recordings) > 1 else ""
            raise EstimationError(
                f"{where}{rig.reference} has a pose at only {len(own.seconds)} instants; record more."
            )
    paths = _smooth(shown.body)
    # Densities come out too large rather than too small: a wide window would take motion from them.
    body = _with_assumption(rig, recordings, _smooth(shown.body, narrow=True))
    inputs = replace(inputs_for(body, _readings(recordings, paths, rig.settings.max_gap_s)), asked=rig)
    felt = _felt(body, recordings, paths, inputs)
    found = shown.values if shown.reckoned is None else as_given(inputs, shown.reckoned, shown.values)
    if _hosts(body) and not found:
        found = _hosts_on_body(body, recordings, shown.body, paths)
    moving, turned = _moving(inputs, shown.body, found)
    others = [s for s in body.mounted if (s.name, "rotation") not in moving.values]
    values = placed(felt, moving, others) | moving.values
    return inputs, replace(moving, bias=-turned, values=values), values


@dataclass(frozen=True)
class _Shown:
    """Poses of the body in each recording; values found on the way; reckoned: the sensor whose dead reckoning showed
    them."""

    body: list[BodyPoses]
    values: Values
    reckoned: str | None = None

    @classmethod
    def by(cls, source: Initializer[Any], rig: Rig, recordings: Sequence[Measurements]) -> _Shown:
        """The poses of the body by the sensors of `source`, which may not be the body."""
        paths, found = source.body_poses(rig, recordings)
        if initializer_of(rig.sensors[rig.reference]) is source:
            return cls(paths, found)
        (name,) = source.sources(rig)
        values = _cameras_on_path(rig, recordings, name, paths)
        return cls(camera_paths(rig, recordings, name, paths, values), seen_from_first(rig, name, values), name)


def _smooth(body: Sequence[BodyPoses], narrow: bool = False) -> list[SmoothPath]:
    """The path of the body in each recording, every STEP_S from its first stamp on."""
    return [own.at(np.arange(0.0, own.seconds[-1], STEP_S), narrow=narrow) for own in body]


def _hosts(rig: Rig) -> list[Sensor]:
    """The sensors at whose measurements keyframes lie, but for the body."""
    return [s for s in rig.mounted if initializer_of(s).hosts_keyframes and s.name != rig.reference_without_imu]


def _hosts_on_body(
    body: Rig, recordings: Sequence[Measurements], shown: Sequence[BodyPoses], paths: Sequence[SmoothPath]
) -> Values:
    """The sensors that host keyframes, placed on the motion that the first pose sensor of `body` shows."""
    hosts = _hosts(body)
    blind = body.without(*(s.name for s in hosts))
    unseen = [m.only(*blind.sensors) for m in recordings]
    alone = _felt(blind, unseen, paths, inputs_for(blind, _readings(unseen, paths)))
    felt = _felt(body, recordings, paths, inputs_for(body, _readings(recordings, paths)))
    return placed(felt, _moving(alone, shown, {})[0], hosts)


def _cameras_on_path(rig: Rig, recordings: Sequence[Measurements], sensor: str, paths: Sequence[BodyPoses]) -> Values:
    """Cameras with feature tracks, placed on the planar `paths` of `sensor`, on which nothing else is known."""
    blank = in_place_of(rig, sensor)
    streams = pose_streams(recordings, sensor, paths)
    posed = [m.only(*(c.name for c in rig.cameras)).with_streams(s) for m, s in zip(recordings, streams, strict=True)]
    smooth = _smooth(paths)
    try:
        return _hosts_on_body(_with_assumption(blank, posed, smooth), posed, paths, smooth)
    except EstimationError as error:
        said = str(error).rstrip(".")
        raise EstimationError(
            f"{said}. Without IMU, target and pose sensor, {sensor} determines the motion on a flat floor only."
        ) from error


def _felt(rig: Rig, recordings: Sequence[Measurements], paths: Sequence[SmoothPath], like: Inputs) -> Inputs:
    """The inputs with the readings that an IMU in the body would have."""
    felt = inputs_for(rig, _readings(recordings, paths), like)
    assert felt.imu is not None
    return replace(felt, imu=replace(felt.imu, forwards=False))


def _moving(inputs: Inputs, shown: Sequence[BodyPoses], found: Values) -> tuple[State, np.ndarray]:
    """The motion of the body without biases, and its angular rate and acceleration (K, 6) at keyframes; `found`: what
    is known of sensors."""
    values = start_values(inputs, found | _identity(inputs))
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


def _with_assumption(rig: Rig, recordings: Sequence[Measurements], paths: Sequence[SmoothPath]) -> Rig:
    """The rig with the assumption as its IMU, which is where the body is."""
    turning, jerking = (
        np.sqrt(np.mean(np.concatenate([_changes(p, what) for p in paths]) ** 2) / LAG_S) + LEAST_DENSITY
        for what in ("rate", "acceleration")
    )
    noise = ImuNoise(WHITE_STEP_S * turning, turning, WHITE_STEP_S * jerking, jerking, ASSUMPTION)
    here = mounted(fixed(np.eye(3)), fixed(np.zeros(3)), fixed(np.zeros(1)))
    imu = ImuSensor(ASSUMPTION, "", noise, Parameter("fixed"), assumed=True)
    if not motion_kinds(rig)[0].hosts_keyframes:
        motion = SmoothMotion(paths, float(turning), float(jerking))
        imu = replace(imu, pose_keyframes_s=keyframe_spacing(rig, recordings, motion))
    return rig.with_sensors(imu, replace(rig.sensors[rig.reference], **here), gravity=0.0)


def keyframe_spacing(rig: Rig, recordings: Sequence[Measurements], motion: SmoothMotion) -> float:
    """Seconds, from LEAST_SPACING_S to the rig's `keyframe_spacing_s`: the largest that all kinds of sensors allow."""
    longest = min(kind.longest_spacing(rig, recordings, motion) for kind in kinds_of(rig))
    return float(np.clip(longest, LEAST_SPACING_S, max(rig.settings.keyframe_spacing_s, LEAST_SPACING_S)))


def _changes(path: SmoothPath, what: str) -> np.ndarray:
    """(n, 3) over LAG_S, where poses show both ends."""
    n = round(LAG_S / STEP_S)
    x = getattr(path, what)
    return (x[n:] - x[:-n])[path.near[n:] & path.near[:-n]]


def _readings(
    recordings: Sequence[Measurements], paths: Sequence[SmoothPath], max_gap_s: float | None = None
) -> list[Measurements]:
    """The recordings with readings of the assumed IMU: zero, but in gaps of poses that are longer than `max_gap_s`; or
    without it those that an IMU in the body would have, where poses show them."""
    out = []
    for m, path in zip(recordings, paths, strict=True):
        stamps = m.origin_ns + np.round(path.seconds * 1e9).astype(np.int64)
        used = path.near.copy() if max_gap_s is None else _bridged(path, max_gap_s)
        used[:1] = True  # its clock begins where the body's does
        gyro, accel = (x[used] * float(max_gap_s is None) for x in (path.rate, path.acceleration))
        out.append(m.with_streams(ImuStream(ASSUMPTION, stamps[used], gyro, accel)))
    return out


def _bridged(path: SmoothPath, max_gap_s: float) -> np.ndarray:
    """(m,) whether poses show the path, or it is unseen for a short while only: for longer an assumption says nothing
    of where the body is."""
    seen = path.seconds[path.near]
    if not len(seen):
        return np.zeros(len(path.seconds), dtype=bool)
    after, ends = np.searchsorted(seen, path.seconds), np.concatenate([[-np.inf], seen, [np.inf]])
    before, behind = ends[after], ends[after + 1]
    return path.near | (behind - before <= max_gap_s)


def _identity(inputs: Inputs) -> Values:
    """The body is where the assumed IMU is, and its target or its frame is the world."""
    sensor = inputs.rig.sensors[inputs.rig.reference_without_imu]
    out, own = given(inputs, sensor), {block.key for block in inputs.layout.blocks}
    for k in range(len(inputs.parts)):
        frame = frame_of(sensor.name, k)
        world = {
            (in_recording(BOARD, k), "tilt"): np.eye(3),
            (frame, FRAME[0]): np.eye(3),
            (frame, FRAME[1]): np.zeros(3),
        }
        out |= {key: value for key, value in world.items() if key in own}
    return out
