"""Initial guess of several LiDARs at rest. A stop has one cloud of each; surfaces that two see show their poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from icalib.data.measurements import LidarStream, Measurements
from icalib.data.stamps import STREAM_S
from icalib.errors import EstimationError
from icalib.estimate.inputs import inputs_for, with_association
from icalib.estimate.problem import keyframe_times, keyframes_for, start_values
from icalib.geometry import so3
from icalib.geometry.targets import NoTarget
from icalib.initialize.initializer import InitialGuess, stated_values
from icalib.initialize.rate_alignment import only_axis
from icalib.initialize.smooth_trajectory import BodyPoses, follow_closely, quiet_motion, rests
from icalib.initialize.trajectories import SINGLE_AXIS_RATE_RATIO
from icalib.motion.factor import Extrinsics
from icalib.motion.point_planes import AT_REST
from icalib.optim.state import State
from icalib.rig import Rig
from icalib.sensors.lidar.initialize.boards import (
    FEWEST_STOPS,
    SAME_STOP_SHARE,
    cloud_changes,
    noting_stops,
    reduced,
    sees_the_same,
)
from icalib.sensors.lidar.initialize.extrinsics import scan_poses
from icalib.sensors.lidar.initialize.registration import LEAST_SCORE, SAME_RAD, Registration, Surfels, register
from icalib.sensors.lidar.initialize.voxel_map import degeneracy_error
from icalib.sensors.parameter import fixed
from icalib.sensors.sensor import mounted


def are_stops(rig: Rig, recordings: Sequence[Measurements]) -> bool:
    """Whether the rig has LiDARs only, each cloud of which is a stop: clouds are too far apart to show a motion."""
    steps = [np.diff(s.seconds) for m in recordings for s in m.lidars]
    return len(rig.lidars) == len(rig.sensors) and all((step > STREAM_S).all() for step in steps)


def at_stops(rig: Rig, recordings: Sequence[Measurements]) -> Sequence[Measurements]:
    """The recordings of LiDARs alone with one cloud of each at each stop, if all recordings stop and their motion shows
    less: because there is none, the scene does not show it, or the rig turns about one axis only."""
    if len(rig.lidars) < 2 or len(rig.lidars) < len(rig.sensors):
        return recordings
    if not all(follow_closely(m.lidars[0].stamps_ns) for m in recordings):
        return recordings
    intervals = [_rests(m.lidars[0]) for m in recordings]
    if not all(len(x) for x in intervals):
        return recordings
    streams = [stream for m in recordings for stream in m.lidars]
    if all(map(sees_the_same, streams)) or degeneracy_error(streams) is not None:
        return [noting_stops(reduced(m, x)) for m, x in zip(recordings, intervals, strict=True)]
    if sum(map(len, intervals)) < FEWEST_STOPS or not all(_turns_about_one_axis(m.lidars[0]) for m in recordings):
        return recordings
    try:
        still = [noting_stops(reduced(m, x)) for m, x in zip(recordings, intervals, strict=True)]
        guess_by_surroundings(rig, still)
    except EstimationError:
        return recordings
    return still


def _rests(stream: LidarStream) -> np.ndarray:
    """(k, 2) first and last stamp [ns] of each stop of a LiDAR."""
    n = len(stream.stamps_ns)
    differ = cloud_changes(stream, np.arange(n))
    return stream.stamps_ns[rests(stream.seconds, differ, quiet_motion(n, differ))]


def _turns_about_one_axis(stream: LidarStream) -> bool:
    """Whether the LiDAR turned about one axis only, as on a floor, by its odometry."""
    try:
        R = scan_poses(stream).rotation
    except EstimationError:
        return True
    return only_axis(so3.log_many(np.ascontiguousarray(R[0].T @ R)), SINGLE_AXIS_RATE_RATIO) is not None


def stops(m: Measurements) -> BodyPoses:
    """Poses at the stops. They do not matter, because each stop has surroundings of its own."""
    seconds = m.lidars[0].seconds
    return BodyPoses(seconds, np.tile(np.eye(3), (len(seconds), 1, 1)), np.zeros((len(seconds), 3)))


def guess_by_surroundings(rig: Rig, recordings: Sequence[Measurements]) -> InitialGuess:
    """The initial guess. Raises EstimationError if a LiDAR sees too little of what others see."""
    at_zero = {s.name: replace(s, time_offset=fixed(np.zeros(1)), clock_restarts=False) for s in rig.lidars}
    body = replace(at_zero[rig.reference], **mounted(fixed(np.eye(3)), fixed(np.zeros(3)), fixed(np.zeros(1))))
    still = rig.with_sensors(*(at_zero | {body.name: body}).values(), target=NoTarget())
    inputs = replace(inputs_for(still, [_same_stamps(m, body.name) for m in recordings]), user_rig=rig)
    inputs = with_association(inputs, AT_REST)
    streams, values = {s.name: s for s in inputs.measurements.lidars}, {}
    for sensor in still.lidars:
        values |= stated_values(inputs, sensor)
    known = {
        name: Extrinsics(values[name, "rotation"], values[name, "translation"])
        for name in streams
        if {(name, "rotation"), (name, "translation")} <= values.keys()
    }
    for name, pose in _poses(streams, known).items():
        values = {(name, "rotation"): pose.R, (name, "translation"): pose.p} | values
    values = start_values(inputs, values)
    keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
    if len(keyframes) == 1:  # factors link a keyframe and the next
        keyframes = keyframes + [0.0, 1.0]
    n = len(keyframes)
    R = np.tile(np.eye(3), (n, 1, 1))
    state = State(keyframes, R, np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 6)), values)
    return replace(inputs, guess=state), state, values


def _same_stamps(m: Measurements, body: str) -> Measurements:
    """The recording with the clouds of stops at which the body has one. Raises EstimationError if there are none."""
    at = m.streams[body].stamps_ns
    near_ns = int(SAME_STOP_SHARE * np.diff(at).min(initial=10**18))
    return reduced(m, at[:, None] + np.array([-near_ns, near_ns]))


def _poses(streams: dict[str, LidarStream], known: dict[str, Extrinsics]) -> dict[str, Extrinsics]:
    """Poses of all LiDARs in the frame of the body, from those that are known. A LiDAR that shares too little with the
    body is placed by another one. Raises EstimationError if a pose is not found, or another one fits as well."""
    surfels, poses = {name: _surfels(stream) for name, stream in streams.items()}, dict(known)
    by_pair: dict[tuple[str, str], Registration | None] = {}
    while missing := [name for name in streams if name not in poses]:
        for pair in product(poses, missing):
            if pair not in by_pair:
                by_pair[pair] = _registered(*(surfels[name] for name in pair))
        best = max(product(poses, missing), key=lambda pair: 0.0 if (f := by_pair[pair]) is None else f.score)
        seen, name = best
        result = by_pair[best]
        if result is None or result.score < LEAST_SCORE:
            share = 0.0 if result is None else result.score
            raise EstimationError(
                f"{name} shares too few surfaces with {seen}: the best pose explains {share:.0%} of them, not "
                f"{LEAST_SCORE:.0%}; stop where both see the same walls and ground, and check units and numbers of the "
                "clouds."
            )
        if result.is_ambiguous:
            raise EstimationError(_ambiguous(name, seen, result, poses[seen]))
        pose, of_seen = result.pose, poses[seen]
        poses[name] = Extrinsics(of_seen.R @ pose.R, of_seen.R @ pose.p + of_seen.p)
    return poses


def _ambiguous(name: str, seen: str, result: Registration, of_seen: Extrinsics) -> str:
    """The sentence on two poses that explain the clouds alike."""
    assert result.rival is not None
    rival = result.rival[0]
    apart, turn = rival.p - result.pose.p, so3.log(np.ascontiguousarray(result.pose.R.T @ rival.R))
    how = f"turned by {np.rad2deg(np.linalg.norm(turn)):.0f} deg and moved by {np.linalg.norm(apart):.1f} m"
    if np.linalg.norm(turn) < SAME_RAD:
        along = ", ".join(f"{x:.2f}" for x in of_seen.R @ apart / np.linalg.norm(apart))
        how = f"moved by {np.linalg.norm(apart):.1f} m along [{along}] of the body, as along parallel walls"
    return (
        f"{name}: two poses in view of {seen} explain its clouds alike, the second {how}; stop at more places where "
        f"walls face three directions, or give rotation and translation of {name} as a guess in the rig file."
    )


def _surfels(stream: LidarStream) -> dict[int, Surfels]:
    """Surfels of each cloud by its stamp."""
    clouds = np.split(stream.xyz, stream.start[1:-1])
    return {int(ns): Surfels.of(cloud) for ns, cloud in zip(stream.stamps_ns, clouds, strict=True)}


def _registered(reference: dict[int, Surfels], other: dict[int, Surfels]) -> Registration | None:
    """The pose of a LiDAR in the frame of `reference`; surfels of the sparser one are searched for in the other."""
    shared = sorted(reference.keys() & other.keys())
    both = [reference[k] for k in shared], [other[k] for k in shared]
    if sum(len(s.flat) for s in both[0]) >= sum(len(s.flat) for s in both[1]):
        return register(*both)
    inverse = register(*both[::-1])
    return inverse and inverse.inverse()
