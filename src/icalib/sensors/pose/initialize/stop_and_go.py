"""Stop-and-go: a robot stands still at some poses, and a camera or another pose sensor sees where it is (hand-eye).

Nothing is assumed of the motion from one pose to the next, so clocks cannot be compared: poses of two sensors belong
together that have the same stamps, or were taken while nothing moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.data.checks.stops import stands_still_between
from icalib.data.measurements import Measurements, PoseStream
from icalib.data.recordings.several import naming
from icalib.errors import EstimationError
from icalib.estimate.problem.assembly import keyframe_times, keyframes_for, start_values
from icalib.estimate.problem.inputs import Inputs, inputs_for
from icalib.geometry.targets.base import BOARD
from icalib.initialize.steps.hand_eye import (
    MAX_UNEXPLAINED_MOTION,
    HandEye,
    PosePairs,
    hand_eye,
    outlier_pairs,
    relative_motions,
    unexplained_motion,
)
from icalib.initialize.steps.rig_file_values import stated_values
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.model.frames import FRAME, frame_of
from icalib.motion.pose_rows import Extrinsics
from icalib.optim.state import Key, State, in_recording
from icalib.rig import PoseSensor, Rig
from icalib.sensors.parameter import fixed
from icalib.sensors.pose.initialize.conventions import placed
from icalib.sensors.pose.initialize.pose_pairs import partners
from icalib.sensors.sensor import MOUNTED_NAMES

FEWEST_PAIRS = 3  # of one recording
NO_TURN_DEG = 1e-3  # between poses, which has no noise even: of a sensor without rotations
HOW = (
    "give both the same stamps where they belong together, stand still for half a second around each, or record while "
    "moving, at 10 Hz or more"
)


def is_stop_and_go(rig: Rig, recordings: Sequence[Measurements], shown: Sequence[BodyPoses]) -> bool:
    """Whether the body, or one of the pose sensors, moved only while it was not seen, and only pose sensors are beside
    the body."""
    others = {s.sensor_type for s in rig.mounted} - {"camera", "pose"}
    if others or (rig.cameras and rig.moves_by_poses):
        return False
    each = [list(shown), *(list(own) for own in zip(*(m.poses for m in recordings), strict=True))]
    return any(all(stands_still_between(s.seconds, s.rotation, s.position) for s in own) for own in each)


def start_from_pairs(
    rig: Rig, recordings: Sequence[Measurements], shown: Sequence[BodyPoses], cameras: dict[Key, np.ndarray]
) -> tuple[Inputs, State, dict[Key, np.ndarray]]:
    """As `start.start`, from where the body was `shown` in each recording, and what its `cameras` are. Time offsets
    are those that the rig file gives, or zero. Raises EstimationError where too few poses belong together."""
    relative = next((s for s in rig.poses if s.kind == "relative"), None)
    if relative is not None:
        raise EstimationError(
            f"{relative.name}: poses taken at rest are compared one by one, which kind: relative does not "
            "allow; write kind: absolute, or record them during motion, at 10 Hz or more."
        )
    own = len(rig.poses) if not rig.cameras else 0
    still = rig.with_sensors(*(_at_rest(s, own > 0 and k == 0) for k, s in enumerate(rig.poses)))
    found, at = dict(cameras), list(recordings)
    for k in range(min(own, 1), len(rig.poses)):
        at, values = _mounted(still, k, at, shown)
        found |= values
    inputs = replace(inputs_for(still, at), asked=rig)
    for sensor in still.poses:
        found |= stated_values(inputs, sensor, MOUNTED_NAMES if sensor.name == rig.reference else ("time_offset",))
    for k in range(len(recordings)):
        frame = frame_of(rig.reference, k)
        world = {(frame, FRAME[0]): np.eye(3), (frame, FRAME[1]): np.zeros(3)}
        found |= world if own else {(in_recording(BOARD, k), "tilt"): np.eye(3)}
    state = _state(inputs, shown, found)
    return inputs, state, state.values


def _at_rest(sensor: PoseSensor, is_body: bool) -> PoseSensor:
    """The sensor, whose clock is known; the body is where it is."""
    offset = np.zeros(1) if sensor.time_offset.value is None else sensor.time_offset.value
    known = replace(sensor, time_offset=fixed(offset), clock_restarts=False)
    return replace(known, rotation=fixed(np.eye(3)), translation=fixed(np.zeros(3))) if is_body else known


def _state(inputs: Inputs, shown: Sequence[BodyPoses], found: dict[Key, np.ndarray]) -> State:
    """At every instant the nearest pose of the body, at rest."""
    values = start_values(inputs, found)
    keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
    t = np.concatenate([own.seconds + part.begin for own, part in zip(shown, inputs.parts, strict=True)])
    R, p = (np.concatenate([getattr(own, name) for own in shown]) for name in ("rotation", "position"))
    k, n = np.searchsorted(0.5 * (t[1:] + t[:-1]), keyframes), len(keyframes)
    return State(keyframes, np.ascontiguousarray(R[k]), p[k], np.zeros((n, 3)), np.zeros((n, 6)), values)


@dataclass(frozen=True)
class _Paired:
    """The poses of a sensor that belong to poses of the body, in one recording, and how many there are of each."""

    pairs: PosePairs
    stream: PoseStream
    counts: tuple[int, int]


def _mounted(
    rig: Rig, index: int, recordings: list[Measurements], shown: Sequence[BodyPoses]
) -> tuple[list[Measurements], dict[Key, np.ndarray]]:
    """The recordings with those poses of a sensor alone that belong to poses of the body, stamped as these; and its
    mount and frames."""
    sensor = rig.poses[index]
    paired = []
    for m, own in zip(recordings, shown, strict=True):
        with naming(m.name if len(recordings) > 1 else ""):
            paired.append(_paired(rig, sensor, m, m.poses[index], own))
    best = int(np.argmax([len(x.stream.stamps_ns) for x in paired]))
    found = _solved(rig, sensor, paired[best])
    values: dict[Key, np.ndarray] = {
        (sensor.name, "rotation"): found.extrinsics.R,
        (sensor.name, "translation"): found.extrinsics.p,
    }
    out = []
    for k, (m, own) in enumerate(zip(recordings, paired, strict=True)):
        here = found if k == best else hand_eye(own.pairs, found.extrinsics, (True, True))
        values |= {
            (frame_of(sensor.name, k), FRAME[0]): here.frame.R,
            (frame_of(sensor.name, k), FRAME[1]): here.frame.p,
        }
        bad = outlier_pairs(here.residual)
        good = np.flatnonzero(~bad)
        columns = {name: getattr(own.stream, name)[good] for name in ("stamps_ns", "rotation", "position")}
        out.append(
            replace(m.with_streams(replace(own.stream, **columns)), notes=(*m.notes, *_notes(rig, sensor, own, bad, m)))
        )
    return out, values


def _notes(rig: Rig, sensor: PoseSensor, own: _Paired, bad: np.ndarray, m: Measurements) -> list[str]:
    n = len(own.stream.stamps_ns)
    words = [
        f"{n} poses of {sensor.name} were taken at rest, each together with one of the {own.counts[0]} of "
        f"{rig.reference}. No motion is assumed in between, and its time_offset is not estimated."
    ]
    if bad.any():
        seconds = own.stream.stamps_ns[bad][:3] - m.origin_ns
        at = ", ".join(f"{1e-9 * x:.3f} s" for x in seconds)
        words.append(
            f"{sensor.name}: {int(bad.sum())} of its {n} poses do not fit the others and were rejected, {at} after "
            f"the first stamp of {rig.reference}."
        )
    return words


def _paired(rig: Rig, sensor: PoseSensor, m: Measurements, stream: PoseStream, shown: BodyPoses) -> _Paired:
    """Raises EstimationError where too few poses belong together."""
    assert sensor.time_offset.value is not None
    offset = float(sensor.time_offset.value[0])
    seconds = (stream.stamps_ns - m.origin_ns) * 1e-9 + offset
    i, k = partners(shown, BodyPoses(seconds, stream.rotation, stream.position))
    counts = len(shown.seconds), len(stream.stamps_ns)
    if len(i) < FEWEST_PAIRS:
        raise EstimationError(
            f"only {len(i)} of the {counts[1]} poses of {sensor.name} were taken together with one of the "
            f"{counts[0]} of {rig.reference}, and {FEWEST_PAIRS} are needed; {HOW}."
        )
    stamps = m.origin_ns + np.round((shown.seconds[i] - offset) * 1e9).astype(np.int64)
    chosen = replace(stream, stamps_ns=stamps, rotation=stream.rotation[k], position=stream.position[k])
    pairs = PosePairs(shown.rotation[i], shown.position[i], chosen.rotation, chosen.position)
    return _Paired(pairs, chosen, counts)


def _solved(rig: Rig, sensor: PoseSensor, own: _Paired) -> HandEye:
    """Raises EstimationError where body and sensor do not move alike, or would if poses were written another way."""
    R, p = sensor.rotation.value, sensor.translation.value
    start = (
        None if R is None and p is None else Extrinsics(np.eye(3) if R is None else R, np.zeros(3) if p is None else p)
    )
    held = sensor.rotation.mode == "fixed", sensor.translation.mode == "fixed"

    def place(stream: PoseStream) -> tuple[tuple[HandEye, float], float]:
        pairs = replace(own.pairs, R_sensor=stream.rotation, p_sensor=stream.position)
        found = hand_eye(pairs, start, held)
        left = unexplained_motion(pairs, found)
        return (found, left), left

    found, left = placed(own.stream, place)
    if left > MAX_UNEXPLAINED_MOTION:
        turns = relative_motions(own.pairs)
        seen, told = (np.rad2deg(np.median(np.linalg.norm(w, axis=1))) for w in (turns.turn_body, turns.turn_sensor))
        if told < NO_TURN_DEG < seen:
            raise EstimationError(
                f"{sensor.name}: its rotation is the same in all poses, although {rig.reference} turns by "
                f"{seen:.1f} deg (median); a pose sensor needs both position and rotation."
            )
        raise EstimationError(
            f"{rig.reference} and {sensor.name} do not move alike: {left:.0%} of the motion between "
            f"{len(own.pairs.p_body)} pairs of poses is unexplained (median rotation {seen:.1f} and {told:.1f} "
            f"deg). Check that each pose of {sensor.name} belongs to the image with its stamp, and that one of "
            "the two is fixed to the other."
        )
    return found
