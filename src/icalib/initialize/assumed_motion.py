"""Without an IMU, but with wheels or a pose sensor: what is assumed of the motion in its place.

The chain keeps its IMU, one that reads zero and knows no gravity. The biases of a node are then minus its angular rate
and minus its acceleration, in the axes of the body, and their random walk is white noise on angular acceleration and on
jerk: a motion prior, by which nodes are tied, and sensors carried from nodes to their own instants. Its densities are
those of the motion itself, as the poses of the body show it; they are the only thing that is taken from these twice.

The body is the first camera, whose target is the world, or the first pose sensor, whose frame is. Cameras that follow
points are placed on the motion of the pose sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from icalib.data.measurements import ImuStream, Measurements
from icalib.errors import EstimationError
from icalib.estimate.problem.assembly import host_times, nodes_for, start_values
from icalib.estimate.problem.inputs import Inputs, inputs_for
from icalib.geometry.targets.base import BOARD
from icalib.initialize.dead_reckoning import (
    as_given,
    camera_paths,
    in_place_of_wheels,
    pose_stream,
    seen_from_first,
    wheel_path,
)
from icalib.initialize.steps.initializer import placed
from icalib.initialize.steps.keyframe_spacing import keyframe_spacing
from icalib.initialize.steps.known_values import given
from icalib.initialize.steps.smooth_path import FEWEST, BodyPoses, SmoothPath
from icalib.motion.nodes import first_nodes
from icalib.optim.state import Key, State, in_recording
from icalib.rig import ImuNoise, ImuSensor, Rig
from icalib.sensors.camera.initialize.recordings import initial_guesses
from icalib.sensors.camera.initialize.tracks.on_motion import track_camera_values
from icalib.sensors.parameter import Parameter, fixed
from icalib.sensors.pose.initialize.conventions import TURNED, WAYS
from icalib.sensors.pose.initialize.extrinsics import check_rate
from icalib.sensors.pose.initialize.stop_and_go import is_stop_and_go, start_from_pairs
from icalib.sensors.pose.residual import FRAME, frame_of
from icalib.sensors.sensor import mounted
from icalib.sensors.wheels.initialize.drive import SidewaysError

ASSUMPTION = "assumed motion"  # no sensor is called so
STEP_S = 0.01  # between readings
WHITE_STEP_S = 5e-3  # white noise is what the walks make of so long a step: keeps covariances regular
LAG_S = 0.1  # over which the change of rate and acceleration tells their densities
LEAST_DENSITY = 1e-3  # rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz): of a body that stood still


Start = tuple[Inputs, State, dict[Key, np.ndarray]]


def start_without_imu(rig: Rig, recordings: Sequence[Measurements]) -> Start:
    """As `start.start`; where all was taken at rest, nothing is assumed.

    Raises EstimationError where the body's poses do not show its motion, or are written another way than they should
    be, or where wheels and pose sensors do not show how they stand.
    """
    try:
        return _start(rig, recordings)
    except SidewaysError as error:
        if rig.moves_by_poses:
            _refuse_other_ways(rig, recordings, error)
        raise


def _refuse_other_ways(rig: Rig, recordings: Sequence[Measurements], error: EstimationError) -> None:
    """Raises EstimationError where the wheels fit poses of the body that are written another way."""
    for words, way in (*WAYS, *TURNED):
        others = [m.with_streams(way(m.poses[0])) for m in recordings]
        try:
            _start(rig, others)
        except EstimationError:
            continue
        raise EstimationError(f"the poses of {rig.poses[0].name} {words}.") from error


def _start(rig: Rig, recordings: Sequence[Measurements]) -> Start:
    """As `start_without_imu`, of poses as they are written."""
    shown, cameras = _shown(rig, recordings)
    if is_stop_and_go(rig, recordings, shown):
        return start_from_pairs(rig, recordings, shown, cameras)
    for m in recordings:
        for stream in m.poses:
            check_rate(stream)
    for own, m in zip(shown, recordings, strict=True):
        if len(own.seconds) < FEWEST:
            where = f"{m.name}: " if len(recordings) > 1 else ""
            raise EstimationError(
                f"{where}{rig.reference} has a pose at only {len(own.seconds)} instants; record more."
            )
    grids = [np.arange(0.0, own.seconds[-1], STEP_S) for own in shown]  # from the body's first stamp on
    paths = [own.at(grid) for own, grid in zip(shown, grids, strict=True)]
    # Densities come out too large rather than too small: a wide window would take motion from them.
    narrow = [own.at(grid, narrow=True) for own, grid in zip(shown, grids, strict=True)]
    body = _with_assumption(rig, recordings, narrow)
    inputs = replace(inputs_for(body, _readings(recordings, paths, rig.settings.max_gap_s)), asked=rig)
    felt = _felt(body, recordings, paths, inputs)
    if body.cameras and body.moves_by_poses:
        cameras = _cameras_on_poses(body, recordings, shown, paths)
    elif not (rig.has_target or rig.moves_by_poses):
        cameras = as_given(inputs, cameras)
    moving, turned = _moving(inputs, shown, cameras)
    others = [s for s in body.mounted if (s.name, "rotation") not in moving.values]
    values = placed(felt, moving, others) | moving.values
    return inputs, replace(moving, bias=-turned, values=values), values


def _cameras_on_poses(
    body: Rig, recordings: Sequence[Measurements], shown: Sequence[BodyPoses], paths: Sequence[SmoothPath]
) -> dict[Key, np.ndarray]:
    """Cameras that follow points, placed on the motion that the first pose sensor of `body` shows."""
    blind = body.with_(cameras=())
    unseen = [m.only(*blind.sensors) for m in recordings]
    alone = _felt(blind, unseen, paths, inputs_for(blind, _readings(unseen, paths)))
    felt = _felt(body, recordings, paths, inputs_for(body, _readings(recordings, paths)))
    return track_camera_values(felt, _moving(alone, shown, {})[0])


def _cameras_on_wheels(rig: Rig, recordings: Sequence[Measurements]) -> tuple[list[BodyPoses], dict[Key, np.ndarray]]:
    """As `_shown`, where cameras follow points and the first wheels show the motion, on a floor."""
    wheels, streams = rig.wheels[0], [m.wheels[0] for m in recordings]
    shown = [wheel_path(wheels, s) for s in streams]
    blank, posed = in_place_of_wheels(rig, wheels), []
    for m, stream, path in zip(recordings, streams, shown, strict=True):
        posed.append(m.only(*blank.sensors).with_streams(pose_stream(stream, path)))
    paths = [own.at(np.arange(0.0, own.seconds[-1], STEP_S)) for own in shown]
    try:
        values = _cameras_on_poses(_with_assumption(blank, posed, paths), posed, shown, paths)
    except EstimationError as error:
        said = str(error).rstrip(".")
        raise EstimationError(
            f"{said}. Without IMU, target and pose sensor, {wheels.name} determines the motion on a flat floor only."
        ) from error
    return camera_paths(rig, recordings, shown, values), seen_from_first(rig, values)


def _felt(rig: Rig, recordings: Sequence[Measurements], paths: Sequence[SmoothPath], like: Inputs) -> Inputs:
    """Of the readings that an IMU in the body would have."""
    felt = inputs_for(rig, _readings(recordings, paths), like)
    assert felt.imu is not None
    return replace(felt, imu=replace(felt.imu, forwards=False))


def _moving(inputs: Inputs, shown: Sequence[BodyPoses], cameras: dict[Key, np.ndarray]) -> tuple[State, np.ndarray]:
    """The body's motion without biases, and its angular rate and acceleration (K, 6) at the nodes."""
    values = start_values(inputs, cameras | _identity(inputs))
    nodes = nodes_for(inputs, host_times(inputs, values))
    starts = first_nodes(inputs.imu, nodes)
    parts = np.split(nodes, starts[1:])
    ways = [own.at(t - part.begin) for own, t, part in zip(shown, parts, inputs.parts, strict=True)]
    R, p, v, rate, force = (
        np.concatenate([getattr(w, name) for w in ways])
        for name in ("rotation", "position", "velocity", "rate", "acceleration")
    )
    still = np.zeros((len(nodes), 6))
    return State(nodes, R, p, v, still, values, starts), np.concatenate([rate, force], axis=1)


def _shown(rig: Rig, recordings: Sequence[Measurements]) -> tuple[list[BodyPoses], dict[Key, np.ndarray]]:
    """The body's poses in each recording, and what was found of the cameras on the way."""
    if rig.moves_by_poses:
        return [BodyPoses(s.seconds, s.rotation, s.position) for s in (m.poses[0] for m in recordings)], {}
    if not rig.has_target:
        return _cameras_on_wheels(rig, recordings)
    seeing = rig.with_(wheels=(), poses=())
    alone = inputs_for(seeing, [m.only(*seeing.sensors) for m in recordings])
    (guess,) = initial_guesses(alone.rig, alone.bodies, [m.measurements for m in alone.motions])
    t, R, p = guess.body_poses(alone.measurements)
    begins = [part.begin for part in alone.parts]
    own = np.searchsorted(begins, t, side="right") - 1
    found = [BodyPoses(t[own == k] - begin, R[own == k], p[own == k]) for k, begin in enumerate(begins)]
    return found, guess.values()


def _with_assumption(rig: Rig, recordings: Sequence[Measurements], paths: Sequence[SmoothPath]) -> Rig:
    """The rig with the assumption as its IMU, which is where the body is."""
    turning, jerking = (
        np.sqrt(np.mean(np.concatenate([_changes(p, what) for p in paths]) ** 2) / LAG_S) + LEAST_DENSITY
        for what in ("rate", "acceleration")
    )
    noise = ImuNoise(WHITE_STEP_S * turning, turning, WHITE_STEP_S * jerking, jerking, ASSUMPTION)
    here = mounted(fixed(np.eye(3)), fixed(np.zeros(3)), fixed(np.zeros(1)))
    imu = ImuSensor(ASSUMPTION, "", noise, Parameter("fixed"), assumed=True)
    if rig.moves_by_poses:
        spacing = keyframe_spacing(rig, recordings, paths, float(turning), float(jerking))
        imu = replace(imu, pose_keyframes_s=spacing)
    return rig.with_sensors(imu, replace(rig.sensors[rig.reference], **here), gravity=0.0)


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


def _identity(inputs: Inputs) -> dict[Key, np.ndarray]:
    """The body is where the assumed IMU is, and its target or its frame is the world."""
    rig, n = inputs.rig, len(inputs.parts)
    sensor = (rig.poses if rig.moves_by_poses else rig.cameras)[0]
    out = given(inputs, sensor)
    if not rig.moves_by_poses:
        return out | {(in_recording(BOARD, k), "tilt"): np.eye(3) for k in range(n) if rig.has_target}
    for k in range(n):
        frame = frame_of(sensor.name, k)
        out |= {(frame, FRAME[0]): np.eye(3), (frame, FRAME[1]): np.zeros(3)}
    return out
