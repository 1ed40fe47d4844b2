"""Hand-eye calibration from stop-and-go recordings: a robot stands still at each pose, and two sensors measure it
there.

No motion is assumed between poses, so that time offsets are unobservable. Pairs of poses have the same stamps, or were
taken during the same stop. The body is the sensor that gives the trajectory: the cameras that observe a target, or the
first pose sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import Measurements, PoseStream
from icalib.data.recordings import naming
from icalib.data.stamps import moved, stands_still_between
from icalib.errors import EstimationError
from icalib.estimate.inputs import Inputs, inputs_for
from icalib.estimate.problem import keyframe_times, keyframes_for, start_values
from icalib.geometry.targets.base import BOARD
from icalib.initialize.hand_eye import (
    MAX_UNEXPLAINED_MOTION,
    HandEye,
    PosePairs,
    hand_eye,
    outlier_pairs,
    relative_motions,
    unexplained_motion,
)
from icalib.initialize.initializer import stated_values
from icalib.initialize.smooth_trajectory import MAX_CLOCK_OFFSET_S, BodyPoses, is_at_rest, rest_motion
from icalib.model.sensor_model import FRAME, frame_of
from icalib.motion.factor import Extrinsics
from icalib.motion.poses import MERGED_WITHIN_S
from icalib.optim.state import Key, State, in_recording
from icalib.rig import PoseSensor, Rig
from icalib.sensors.parameter import fixed
from icalib.sensors.pose.initialize.conventions import with_checked_convention
from icalib.sensors.sensor import MOUNTED_NAMES

MIN_POSE_PAIRS = 3  # pairs in one recording; hand-eye calibration needs two motions about different axes
NO_ROTATION_DEG = 1e-3  # smaller median rotation between poses: the sensor reports no rotations (noise is larger)
ADVICE = (
    "give both the same stamps where they belong together, stand still for half a second around each, or record while "
    "moving, at 10 Hz or more"
)


def is_stop_and_go(rig: Rig, recordings: Sequence[Measurements], body: Sequence[BodyPoses]) -> bool:
    """Whether the body or a pose sensor stood still at all its poses, and the rig has only cameras and pose sensors.
    body: poses of the body in each recording."""
    others = {s.sensor_type for s in rig.mounted} - {"camera", "pose"}
    if others or (rig.cameras and rig.moves_by_poses):
        return False
    each = [list(body), *(list(poses) for poses in zip(*(m.poses for m in recordings), strict=True))]
    return any(all(stands_still_between(s.seconds, s.rotation, s.position) for s in poses) for poses in each)


def state_from_pairs(
    rig: Rig, recordings: Sequence[Measurements], body: Sequence[BodyPoses], cameras: dict[Key, np.ndarray]
) -> tuple[Inputs, State, dict[Key, np.ndarray]]:
    """Inputs, initial state and its values from pairs of poses. body: poses of the body in each recording; cameras:
    parameters of the cameras. Time offsets are those of the rig file, or 0. Raises EstimationError if pairs are too
    few, or a pose sensor is relative."""
    relative = next((s for s in rig.poses if s.kind == "relative"), None)
    if relative is not None:
        raise EstimationError(
            f"{relative.name}: poses taken at rest are compared one by one, which kind: relative does not "
            "allow; write kind: absolute, or record them during motion, at 10 Hz or more."
        )
    is_body = not rig.cameras  # whether the first pose sensor is the body
    still = rig.with_sensors(*(_with_known_clock(s, is_body and k == 0) for k, s in enumerate(rig.poses)))
    values, at = dict(cameras), list(recordings)
    for k in range(int(is_body), len(rig.poses)):
        at, mounted = _with_extrinsics(still, k, at, body)
        values |= mounted
    inputs = replace(inputs_for(still, at), user_rig=rig)
    for sensor in still.poses:
        values |= stated_values(inputs, sensor, MOUNTED_NAMES if sensor.name == rig.reference else ("time_offset",))
    for k in range(len(recordings)):
        frame = frame_of(rig.reference, k)
        world = {(frame, FRAME[0]): np.eye(3), (frame, FRAME[1]): np.zeros(3)}
        values |= world if is_body else {(in_recording(BOARD, k), "tilt"): np.eye(3)}
    state = _state(inputs, body, values)
    return inputs, state, state.values


def _with_known_clock(sensor: PoseSensor, is_body: bool) -> PoseSensor:
    """The sensor with its time offset fixed; the body also gets the identity as fixed extrinsics."""
    offset = np.zeros(1) if sensor.time_offset.value is None else sensor.time_offset.value
    known = replace(sensor, time_offset=fixed(offset), clock_restarts=False)
    return replace(known, rotation=fixed(np.eye(3)), translation=fixed(np.zeros(3))) if is_body else known


def _state(inputs: Inputs, body: Sequence[BodyPoses], extrinsics: dict[Key, np.ndarray]) -> State:
    """The state at rest: each keyframe has the nearest pose of the body and zero velocity."""
    values = start_values(inputs, extrinsics)
    keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
    t = np.concatenate([poses.seconds + part.begin for poses, part in zip(body, inputs.parts, strict=True)])
    R, p = (np.concatenate([getattr(poses, name) for poses in body]) for name in ("rotation", "position"))
    k, n = np.searchsorted(0.5 * (t[1:] + t[:-1]), keyframes), len(keyframes)
    return State(keyframes, np.ascontiguousarray(R[k]), p[k], np.zeros((n, 3)), np.zeros((n, 6)), values)


@dataclass(frozen=True)
class _PairedPoses:
    """Paired poses of body and sensor in one recording. stream: the paired poses of the sensor with stamps of the body;
    counts: total numbers of poses of body and sensor."""

    pairs: PosePairs
    stream: PoseStream
    counts: tuple[int, int]


def _with_extrinsics(
    rig: Rig, index: int, recordings: list[Measurements], body: Sequence[BodyPoses]
) -> tuple[list[Measurements], dict[Key, np.ndarray]]:
    """Recordings that keep only paired inlier poses of the sensor number `index`, and values of its extrinsics and
    frames. The extrinsics come from the recording with most pairs."""
    sensor = rig.poses[index]
    paired = []
    for m, poses in zip(recordings, body, strict=True):
        with naming(m.name if len(recordings) > 1 else ""):
            paired.append(_paired_poses(rig, sensor, m, m.poses[index], poses))
    best = int(np.argmax([len(x.stream.stamps_ns) for x in paired]))
    solution = _hand_eye(rig, sensor, paired[best])
    values: dict[Key, np.ndarray] = {
        (sensor.name, "rotation"): solution.extrinsics.R,
        (sensor.name, "translation"): solution.extrinsics.p,
    }
    out = []
    for k, (m, pairing) in enumerate(zip(recordings, paired, strict=True)):
        fitted = solution if k == best else hand_eye(pairing.pairs, solution.extrinsics, (True, True))
        values |= {
            (frame_of(sensor.name, k), FRAME[0]): fitted.frame.R,
            (frame_of(sensor.name, k), FRAME[1]): fitted.frame.p,
        }
        out.append(_with_inliers(rig, sensor, pairing, outlier_pairs(fitted.residual), m))
    return out, values


def _with_inliers(rig: Rig, sensor: PoseSensor, paired: _PairedPoses, bad: np.ndarray, m: Measurements) -> Measurements:
    """The recording with the paired poses of one sensor, except the outliers `bad` (n,) bool, and with notes."""
    good = np.flatnonzero(~bad)
    columns = {"stamps_ns": paired.stream.stamps_ns[good], **_rows(paired.stream, good)}
    notes = (*m.notes, *_notes(rig, sensor, paired, bad, m))
    return replace(m.with_streams(replace(paired.stream, **columns)), notes=notes)


def _notes(rig: Rig, sensor: PoseSensor, paired: _PairedPoses, bad: np.ndarray, m: Measurements) -> list[Remark]:
    """Notes on the number of pairs, and on the rejected poses `bad` (n,) bool."""
    n = len(paired.stream.stamps_ns)
    words = [
        Remark(
            "poses_at_rest",
            f"{n} poses of {sensor.name} were taken at rest, each together with one of the {paired.counts[0]} of "
            f"{rig.reference}. No motion is assumed in between, and its time_offset is not estimated.",
        )
    ]
    if bad.any():
        seconds = paired.stream.stamps_ns[bad][:3] - m.origin_ns
        at = ", ".join(f"{1e-9 * x:.3f} s" for x in seconds)
        sentence = (
            f"{sensor.name}: {int(bad.sum())} of its {n} poses do not fit the others and were rejected, {at} after "
            f"the first stamp of {rig.reference}."
        )
        words.append(Remark("poses_at_rest_rejected", sentence))
    return words


def _paired_poses(rig: Rig, sensor: PoseSensor, m: Measurements, stream: PoseStream, body: BodyPoses) -> _PairedPoses:
    """Matching poses of body and sensor in one recording. Raises EstimationError if they are too few."""
    assert sensor.time_offset.value is not None
    offset = float(sensor.time_offset.value[0])
    seconds = (stream.stamps_ns - m.origin_ns) * 1e-9 + offset
    i, k = matched_poses(body, BodyPoses(seconds, stream.rotation, stream.position))
    counts = len(body.seconds), len(stream.stamps_ns)
    if len(i) < MIN_POSE_PAIRS:
        raise EstimationError(
            f"only {len(i)} of the {counts[1]} poses of {sensor.name} were taken together with one of the "
            f"{counts[0]} of {rig.reference}, and {MIN_POSE_PAIRS} are needed; {ADVICE}."
        )
    stamps = m.origin_ns + np.round((body.seconds[i] - offset) * 1e9).astype(np.int64)
    chosen = replace(stream, stamps_ns=stamps, **_rows(stream, k))
    pairs = PosePairs(body.rotation[i], body.position[i], chosen.rotation, chosen.position)
    return _PairedPoses(pairs, chosen, counts)


def _rows(stream: PoseStream, which: np.ndarray) -> dict[str, np.ndarray]:
    """Rows of all arrays of a stream but its stamps."""
    return {name: values[which] for name, values in stream.columns().items() if len(values)}


def _hand_eye(rig: Rig, sensor: PoseSensor, paired: _PairedPoses) -> HandEye:
    """Hand-eye solution of one recording. Raises EstimationError if motions of body and sensor disagree, or agree only
    with another convention of poses."""
    R, p = sensor.rotation.value, sensor.translation.value
    start = (
        None if R is None and p is None else Extrinsics(np.eye(3) if R is None else R, np.zeros(3) if p is None else p)
    )
    fixed = sensor.rotation.mode == "fixed", sensor.translation.mode == "fixed"

    def place(stream: PoseStream) -> tuple[tuple[HandEye, float], float]:
        pairs = replace(paired.pairs, R_sensor=stream.rotation, p_sensor=stream.position)
        solution = hand_eye(pairs, start, fixed)
        unexplained = unexplained_motion(pairs, solution)
        return (solution, unexplained), unexplained

    solution, unexplained = with_checked_convention(paired.stream, sensor, place)
    if unexplained > MAX_UNEXPLAINED_MOTION:
        turns = relative_motions(paired.pairs)
        by_body, by_sensor = (
            np.rad2deg(np.median(np.linalg.norm(w, axis=1))) for w in (turns.turn_body, turns.turn_sensor)
        )
        if by_sensor < NO_ROTATION_DEG < by_body:
            raise EstimationError(
                f"{sensor.name}: its rotation is the same in all poses, although {rig.reference} turns by "
                f"{by_body:.1f} deg (median); a pose sensor needs both position and rotation."
            )
        raise EstimationError(
            f"{rig.reference} and {sensor.name} do not move alike: {unexplained:.0%} of the motion between "
            f"{len(paired.pairs.p_body)} pairs of poses is unexplained (median rotation {by_body:.1f} and "
            f"{by_sensor:.1f} deg). Check that each pose of {sensor.name} belongs to the image with its stamp, and "
            "that one of the two is fixed to the other."
        )
    return solution


# Matches poses of two sensors that were taken at the same stop of a robot.

MAX_STOP_SHARE = 0.2  # share of the time between stops; stamps closer than this belong to the same stop
MIN_STOP_INTERVAL_S = 1.0  # least median step between poses of a sensor that measures at stops only


def matched_poses(body: BodyPoses, sensor: BodyPoses) -> tuple[np.ndarray, np.ndarray]:
    """Indices (n,) of poses of the body, increasing, and indices (n,) of the matching poses of the sensor, on one
    clock.

    A match has the same stamps. If most poses have no such match, there are two cases. If both sensors have poses at
    stops only, mutually nearest poses match. Otherwise they match if the sensor with more poses is at rest around them.
    """
    i, k = _mutually_nearest(body, sensor)
    apart = np.abs(body.seconds[i] - sensor.seconds[k])
    same = apart <= MERGED_WITHIN_S
    if same.sum() >= 0.5 * min(len(body.seconds), len(sensor.seconds)):
        return i[same], k[same]
    steps = [float(np.median(np.diff(poses.seconds))) if len(poses.seconds) > 1 else np.inf for poses in (body, sensor)]
    if min(steps) > MIN_STOP_INTERVAL_S:
        near = apart < MAX_STOP_SHARE * min(steps)
        return i[near], k[near]
    dense = body if steps[0] < steps[1] else sensor
    differ = partial(moved, dense.rotation, dense.position)
    limit = rest_motion(len(dense.seconds), differ)
    rest = same | is_at_rest(dense.seconds, 0.5 * (body.seconds[i] + sensor.seconds[k]), differ, limit)
    rest &= apart <= MAX_CLOCK_OFFSET_S
    return i[rest], k[rest]


def _mutually_nearest(body: BodyPoses, sensor: BodyPoses) -> tuple[np.ndarray, np.ndarray]:
    """Indices (n,) of poses of the body and (n,) of the sensor that are mutually nearest in time."""
    k = np.searchsorted(0.5 * (sensor.seconds[1:] + sensor.seconds[:-1]), body.seconds)
    i = np.searchsorted(0.5 * (body.seconds[1:] + body.seconds[:-1]), sensor.seconds)
    matched = np.flatnonzero(i[k] == np.arange(len(k)))
    return matched, k[matched]
