"""Rounds of association and solve: from approximate extrinsics of LiDARs to points on planes.

Cameras give the trajectory, or else the first LiDAR. All other LiDARs are aligned to it. Then points are associated
with planes and all parameters are solved, in rounds with decreasing tolerance.

Association of points with planes that several LiDARs share, repeated in each round of association and solve.

Each round transforms all points to the world by the current state, finds planes there, and associates points with them.
The tolerance allows for errors of that state. A plane keeps its name from round to round if it keeps its points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import LidarStream
from icalib.detection.planes import MOST_POINTS, ExtractedPlanes, PlaneSearch, find_planes
from icalib.errors import EstimationError
from icalib.estimate.estimate import first_pass
from icalib.estimate.inputs import Inputs, with_association
from icalib.estimate.problem import keyframe_times, keyframes_for, motion_of, start_values
from icalib.geometry import so3
from icalib.geometry.planes import plane_of
from icalib.initialize.initializer import (
    KnownExtrinsics,
    converted_offset,
    fullest_recording,
    known_extrinsics,
    known_names,
    merged_values,
    naming_recording,
    offset_of_each_clock,
    single_recording,
    state_of_recording,
    stated_values,
    states_from_best,
)
from icalib.motion.point_planes import PlaneAssociation, are_somewhere, count_points, joined_associations, thinned
from icalib.motion.poses import EstimatedMotion, are_near_keyframes, instants, sweep
from icalib.optim.state import Key, State
from icalib.rig import Rig
from icalib.sensors.lidar.binning import (
    COARSE_BIN_S,
    AssociatedPoints,
    LidarNoise,
    Moments,
    each_in_world,
    in_world,
    take_moments,
)
from icalib.sensors.lidar.board_factor import ON_SHEET, TargetSheet
from icalib.sensors.lidar.initialize.extrinsics import lidar_and_motion, lidar_on_motion
from icalib.sensors.lidar.initialize.voxel_map import explaining_degeneracy
from icalib.sensors.lidar.model import FIRST_RANGE_SIGMA_M
from icalib.sensors.lidar.residual import true_points
from icalib.sensors.lidar.spec import Lidar
from icalib.sensors.sensor import MOUNTED_NAMES

# The rounds diverge if the share of points on planes falls below both: a share of all points, and a ratio to the share
# in the first round.
MIN_LAST_SHARE, MIN_RELATIVE_SHARE = 0.2, 0.7
# Share of the points that are seen through other planes, at most. Simulated rooms: 0.012 at most where the result was
# within 0.05 deg, 0.078 and 0.21 where drift had doubled walls and it was 0.13 and 0.33 deg off.
MAX_DOUBLED = 0.05


def state_from_lidar(inputs: Inputs) -> State:
    """The initial state from the first LiDAR and the IMU. The extrinsics come from the recording with most points.

    Raises EstimationError if a recording does not determine the trajectory.
    """

    def state_of(recording: Inputs, extrinsics: KnownExtrinsics | None) -> State:
        with explaining_degeneracy(recording.measurements.lidars[:1]):
            return _single_state(recording, extrinsics)

    first = inputs.rig.lidars[0]
    return states_from_best(inputs, first, fullest_recording(inputs, first.name), state_of)


def _single_state(inputs: Inputs, extrinsics: KnownExtrinsics | None = None) -> State:
    """The initial state of one recording. extrinsics: those known of the LiDAR from another recording."""
    assert inputs.imu is not None
    lidar, stream = inputs.rig.lidars[0], inputs.measurements.lidars[0]
    try:
        guess, motion = lidar_and_motion(
            inputs.imu, stream, inputs.rig.gravity, extrinsics or known_extrinsics(inputs, lidar)
        )
    except EstimationError:
        known = known_extrinsics(inputs, lidar, guesses=True)
        if extrinsics is not None or known.rotation is None or known.offset is None:
            raise
        # The motion is insufficient: the initial guess of the rig file is used as known extrinsics.
        guess, motion = lidar_and_motion(inputs.imu, stream, inputs.rig.gravity, known)
    # Rotation and offset from angular rates are more accurate than a guess, which would make planes too thick to
    # detect.
    names = ("translation", *known_names(lidar)) if guess.rotation_observable else MOUNTED_NAMES
    estimated, known = guess.values(lidar.name), stated_values(inputs, lidar, names)
    initial = merged_values(lidar, known, estimated) if guess.rotation_observable else estimated | known
    values = start_values(inputs, initial)
    hosts = {(x.name, "time_offset"): values[lidar.name, "time_offset"] for x in inputs.rig.lidars}
    first, times = next(iter(keyframe_times(inputs, hosts).items()))
    keyframes = keyframes_for(inputs, {first: times})
    rotation, position, velocity = motion.at(keyframes)
    return State(keyframes, rotation, position, velocity, np.tile(motion.bias, (len(keyframes), 1)), values)


def with_lidars(inputs: Inputs, state: State) -> tuple[Inputs, State]:
    """Inputs with points associated with planes, and the state with planes after the rounds. `state` has the trajectory
    and initial values of all parameters. Raises EstimationError if there are no planes."""
    inputs = with_known_motion(inputs, state)
    recordings = points_by_recording(inputs)
    if any((s.plane >= 0).any() for streams in recordings for s in streams):
        association = joined_associations([association_of_streams(streams) for streams in recordings])
        return with_association(inputs, association), replace(
            state, values=state.values | fitted_planes(inputs, state, association)
        )
    with explaining_degeneracy(inputs.measurements.lidars):
        return _after_rounds(inputs, state, recordings)


def _after_rounds(inputs: Inputs, state: State, recordings: Sequence[tuple[LidarStream, ...]]) -> tuple[Inputs, State]:
    """Inputs and state after all rounds, see `with_lidars`. All rounds except the last use thinned points. A round is
    repeated where its solve turns a LiDAR by more than the round assumed the state to be off, until MOST_EARLY_ROUNDS
    have been made."""
    step = odd_step(sum(len(s.xyz) for s in inputs.measurements.lidars), MOST_EARLY_POINTS)
    fewer = _thinned_inputs(inputs, step)
    associations: Sequence[AssociatedPlanes | None] = [None] * len(recordings)
    shares, k = [], 0
    for _ in range(MOST_EARLY_ROUNDS):
        fewer, state, associations = _associated(fewer, state, k, associations)
        shares.append(_share_on_planes(fewer.association))
        before, state = state, first_pass(_less_certain(fewer, k), state)
        k += _turned(inputs.rig, before, state) < STATE_ERRORS[k]
        if k == LAST_ROUND:
            break
    early = [
        _unthinned(a, streams, first, step)
        for a, streams, first in zip(associations, recordings, _first_points(recordings), strict=True)
    ]
    inputs, state, associations = _associated(inputs, state, LAST_ROUND, early)
    names = " and ".join(s.name for s in inputs.measurements.lidars)
    check_shares([*shares, _share_on_planes(inputs.association)], names)
    if inputs.rig.assumes_motion and isinstance(inputs.rig.sensors[inputs.rig.reference_without_imu], Lidar):
        check_opaque(max(a.doubled for a in associations), names)
    return inputs, state


def _associated(
    inputs: Inputs, state: State, k: int, before: Sequence[AssociatedPlanes | None]
) -> tuple[Inputs, State, list[AssociatedPlanes]]:
    """Association of round k at `state`, without a solve. Returns inputs, state with planes, and the association of
    each recording. before: associations of the previous round, None in the first."""
    noise = max(x.range_noise_m or FIRST_RANGE_SIGMA_M for x in inputs.rig.lidars)
    associations = []
    for r, streams in enumerate(points_by_recording(inputs)):
        with naming_recording(inputs, r):
            sheet = TargetSheet.of(inputs.bodies, state, r) if k else None  # the first round registers the clouds
            associations.append(associate(streams, motion_of(inputs, state), round_search(k, noise), before[r], sheet))
    association = joined_associations([a.association for a in associations])
    planes = np.concatenate([a.planes for a in associations])
    values = _without_planes(state) | dict(zip(association.keys, planes, strict=True))
    return with_association(inputs, association), replace(state, values=values), associations


def _less_certain(inputs: Inputs, k: int) -> Inputs:
    """The inputs with the registration error of round k as a part of the noise of points. Surfaces that are flat to
    within this error, and not to within the noise, do not bend the trajectory."""

    def noisier(lidar: Lidar, stream: LidarStream) -> Lidar:
        distance = float(np.sqrt((stream.xyz**2).sum(axis=1).mean()))
        noise = lidar.range_noise_m or FIRST_RANGE_SIGMA_M
        return replace(lidar, range_noise_m=float(np.hypot(noise, STATE_ERRORS[k] * np.hypot(1.0, distance))))

    lidars = zip(inputs.rig.lidars, inputs.measurements.lidars, strict=True)
    return replace(inputs, rig=inputs.rig.with_(lidars=tuple(noisier(*x) for x in lidars)))


def _turned(rig: Rig, before: State, after: State) -> float:
    """Largest rotation [rad] between the attitudes of a LiDAR in two states."""
    keys = [(x.name, "rotation") for x in rig.lidars]
    return max(float(np.linalg.norm(so3.log(np.ascontiguousarray(before.values[k].T @ after.values[k])))) for k in keys)


def _thinned_inputs(inputs: Inputs, step: int) -> Inputs:
    """The inputs with every `step`th point."""
    fewer = [_every(step, s) for s in inputs.measurements.lidars]
    return replace(inputs, measurements=inputs.measurements.with_streams(*fewer))


def _first_points(recordings: Sequence[tuple[LidarStream, ...]]) -> np.ndarray:
    """(R, L) index of the first point of each recording among all points of each LiDAR."""
    sizes = np.array([[len(s.xyz) for s in streams] for streams in recordings])
    return np.cumsum(sizes, axis=0) - sizes


def _unthinned(
    associated: AssociatedPlanes | None, streams: tuple[LidarStream, ...], first: np.ndarray, step: int
) -> AssociatedPlanes | None:
    """`associated`, of points thinned by `step`, expanded to all points of a recording; points that were left
    out get no plane. first (L,): see `_first_points`."""
    if associated is None:
        return None
    planes = tuple(np.full(len(s.xyz), -1, np.int32) for s in streams)
    for plane, plane_of_thinned, n in zip(planes, associated.association.plane, first, strict=True):
        plane[-n % step :: step] = plane_of_thinned
    return replace(associated, association=replace(associated.association, plane=planes))


def _share_on_planes(association: PlaneAssociation) -> float:
    """Share of the points that lie on planes."""
    return float(sum((p >= 0).sum() for p in association.plane) / max(sum(len(p) for p in association.plane), 1))


def check_shares(shares: Sequence[float], names: str) -> None:
    """Raises EstimationError if the rounds diverge. shares: share of points on planes after each round; names:
    LiDARs."""
    first, last = shares[0], shares[-1]
    if last < MIN_LAST_SHARE and last < MIN_RELATIVE_SHARE * first:
        raise EstimationError(
            f"fewer and fewer points of {names} lie on planes ({first:.0%}, then {last:.0%}), so the initial "
            "guess is too far off; correct rotation, translation and time_offset in the rig file, or remove "
            "them so that they are estimated."
        )


def check_opaque(doubled: float, names: str) -> None:
    """Raises EstimationError if the motion has drifted, so that walls stand twice. doubled: share of the points that
    were seen through other planes; names: LiDARs."""
    if doubled > MAX_DOUBLED:
        raise EstimationError(
            f"{doubled:.0%} of the points of {names} on planes were seen through other planes, so walls stand twice: "
            "the motion by the scans has drifted. Record where each scan sees walls and floor in three directions, "
            "away from glass, or add an IMU."
        )


def _without_planes(state: State) -> dict[Key, np.ndarray]:
    """Values of the state without those of planes."""
    return {key: value for key, value in state.values.items() if key[1] != "plane"}


def with_known_motion(inputs: Inputs, state: State) -> Inputs:
    """Inputs without points that are not finite, and without scans far from the keyframes of `state`.

    The model does not include the errors of poses propagated so far. Raises EstimationError if no scan is left.
    """
    measured, lidars, notes = inputs.measurements, [], list(inputs.measurements.notes)
    for stream in measured.lidars:
        begin = instants(stream, state.values)
        last, some = np.zeros(len(begin)), np.diff(stream.start) > 0
        last[some] = np.maximum.reduceat(stream.offset_s, stream.start[:-1][some]) if some.any() else 0.0
        known = are_near_keyframes(state.seconds, begin) & are_near_keyframes(state.seconds, begin + last)
        if not known.any():
            raise EstimationError(
                f"{stream.name}: none of its scans falls within the recording of the other sensors; check that the "
                "clocks overlap, or the time_offset in the rig file."
            )
        if not known.all():
            sentence = (
                f"{np.count_nonzero(~known)} of {len(known)} scans of {stream.name} are ignored, because no "
                "other sensor determines the motion at that time."
            )
            notes.append(Remark("scans_without_motion", sentence))
        lidars.append(stream.some(np.repeat(known, np.diff(stream.start)) & are_somewhere(stream.xyz)))
    return replace(inputs, measurements=replace(measured.with_streams(*lidars), notes=tuple(notes)))


def lidar_values(inputs: Inputs, state: State) -> dict[Key, np.ndarray]:
    """Initial extrinsics and time offsets of all LiDARs, given the trajectory in `state`.

    A LiDAR without values in `state` gets those of the rig file, or else those from its scans. For a LiDAR with values
    in `state`, only the known values of the rig file are returned. Raises EstimationError if a recording does not
    determine them.
    """
    out: dict[Key, np.ndarray] = {}
    for i, lidar in enumerate(inputs.rig.lidars):
        if (lidar.name, "rotation") in state.values:
            out |= stated_values(inputs, lidar, known_names(lidar))
            continue
        known = stated_values(inputs, lidar)
        if len(known) < len(MOUNTED_NAMES):
            k = fullest_recording(inputs, inputs.rig.lidars[i].name)
            recording, motion = single_recording(inputs, k), state_of_recording(inputs, k, state)
            assert recording.imu is not None
            stream = recording.measurements.lidars[i]
            with naming_recording(inputs, k), explaining_degeneracy([stream]):
                guess = lidar_on_motion(recording.imu, stream, motion, known_extrinsics(recording, lidar))
            offsets = np.array([converted_offset(guess.offset, lidar.name, recording, inputs)])
            if lidar.clock_restarts:
                extrinsics = KnownExtrinsics(guess.rotation, guess.position)
                others = partial(_offset_on_motion, inputs, state, i, extrinsics)
                offsets = offset_of_each_clock(inputs, lidar.name, others, {k: guess.offset})
            known = guess.values(lidar.name) | {(lidar.name, "time_offset"): offsets} | known
        out |= known
    return out


def _offset_on_motion(inputs: Inputs, state: State, lidar: int, extrinsics: KnownExtrinsics, recording: int) -> float:
    """Time offset [s] of the LiDAR with index `lidar` in one recording, relative to the first stamps of that recording;
    extrinsics: those known."""
    single, motion = single_recording(inputs, recording), state_of_recording(inputs, recording, state)
    assert single.imu is not None
    stream = single.measurements.lidars[lidar]
    with explaining_degeneracy([stream]):
        return lidar_on_motion(single.imu, stream, motion, extrinsics).offset


def fitted_planes(inputs: Inputs, state: State, association: PlaneAssociation) -> dict[Key, np.ndarray]:
    """Planes fitted to points with known planes at `state` (total least squares), as values of a state. Very large
    clouds are thinned."""
    motion, sums = motion_of(inputs, state), np.zeros((association.count, 4, 4))
    for recorded, plane in zip(inputs.measurements.lidars, association.plane, strict=True):
        if (plane >= 0).any():
            stream = true_points(recorded, state)
            some = AssociatedPoints(stream, thinned(plane), np.zeros((association.count, 6)))
            moments = take_moments(some, motion, LidarNoise(1.0), COARSE_BIN_S)
            _add_in_world(moments, motion, stream, sums)
    out = {}
    for key, M in zip(association.keys, sums, strict=True):
        centre = M[1:, 0] / M[0, 0]
        spread = M[1:, 1:] / M[0, 0] - np.outer(centre, centre)
        out[key] = plane_of(np.linalg.eigh(spread)[1][:, 0], centre)
    return out


def _add_in_world(moments: Moments, motion: EstimatedMotion, stream: LidarStream, sums: np.ndarray) -> None:
    """Adds the sums of (1, x) (1, x)^T over the points x of each plane, in the world, to sums (P, 4, 4)."""
    at = sweep(motion, stream.name, instants(stream, motion.state.values, moments.seconds))
    bin_of = np.repeat(np.arange(len(moments.seconds)), np.diff(moments.start))
    L, A = np.zeros((len(bin_of), 4, 4)), np.zeros((len(bin_of), 4, 4))
    L[:, *np.tril_indices(4)] = moments.root
    A[:, 0, 0], A[:, 1:, 0], A[:, 1:, 1:] = 1.0, at.position[bin_of], at.rotation[bin_of]
    X = A @ L
    np.add.at(sums, moments.plane, X @ X.transpose(0, 2, 1))


def points_by_recording(inputs: Inputs) -> list[tuple[LidarStream, ...]]:
    """For each recording, the streams of all LiDARs on the joined clock with the points of this recording. Scans of
    other recordings stay as empty scans."""
    streams = inputs.measurements.lidars
    if len(inputs.parts) == 1:
        return [streams]
    scans = [[len(part.measurements.lidars[i].stamps_ns) for part in inputs.parts] for i in range(len(streams))]
    recording_of_scan = [np.repeat(np.arange(len(n)), n) for n in scans]
    return [
        tuple(s.some(np.repeat(o == r, np.diff(s.start))) for s, o in zip(streams, recording_of_scan, strict=True))
        for r in range(len(inputs.parts))
    ]


MOST_TRACED = 20_000  # points whose beams are traced: a share of 1 % has a standard deviation of 0.1 %
# Points of all rounds but the last, at most: with 2 million the result moves by 0.05 sigma, at twice the time.
MOST_EARLY_POINTS = 500_000
# Assumed error of the state in each round: position [m], and rotation about the sensor [rad].
STATE_ERRORS = (0.03, 0.01, 0.003, 0.001)
LAST_ROUND = len(STATE_ERRORS) - 1
MOST_EARLY_ROUNDS = 10  # a guess 8 deg off about each axis takes six
MIN_PLANE_POINTS = 100  # points of a plane: with fewer, its normal is too uncertain to be of use
MIN_KEPT_POINTS = 0.5  # share of the associated points of a plane from the old plane whose name it keeps


@dataclass(frozen=True)
class AssociatedPlanes:
    """Points associated with planes. planes (P, 6): normal, and a point [m], in the world frame; ordered as the names
    in `association`. doubled: share of the points that were seen through other planes."""

    association: PlaneAssociation
    planes: np.ndarray
    doubled: float = 0.0

    @property
    def values(self) -> dict[Key, np.ndarray]:
        """The planes as values of a state."""
        return {key: plane.copy() for key, plane in zip(self.association.keys, self.planes, strict=True)}


def round_search(k: int, noise_m: float) -> PlaneSearch:
    """Tolerances of the plane search in round k, counted from 0. noise_m: standard deviation of a point [m]."""
    error = STATE_ERRORS[k]
    return PlaneSearch(noise_m=noise_m, position_m=error, angle_rad=error)


def associate(
    streams: Sequence[LidarStream],
    motion: EstimatedMotion,
    search: PlaneSearch,
    before: AssociatedPlanes | None = None,
    sheet: TargetSheet | None = None,
) -> AssociatedPlanes:
    """Planes and their points at the state of `motion`. A plane gets the name of the plane in `before` with which it
    shares most points. Points on the `sheet` are on no other plane. Raises EstimationError if there is no plane."""
    streams = [true_points(s, motion.state) for s in streams]
    step = odd_step(sum(len(s.xyz) for s in streams))
    thinned = [in_world(motion, _every(step, s)) for s in streams]
    away = [sheet and sheet.away(*cloud, search, MIN_PLANE_POINTS) for cloud in thinned]
    sheets = [None if far is None else sheet for far in away]
    others = [(x, o) if far is None else (x[far], o[far]) for far, (x, o) in zip(away, thinned, strict=True)]
    points, origins = zip(*others, strict=True)
    planes = find_planes(np.concatenate(points), np.concatenate(origins), search)
    if not planes.count:
        names = " and ".join(s.name for s in streams)
        raise EstimationError(
            f"{names} saw no flat surface of {search.smallest_m2} m^2 or more; record among walls and floors, "
            "or check the point times."
        )
    plane = tuple(_plane_of_points((planes, on), motion, s, search) for s, on in zip(streams, sheets, strict=True))
    names = _plane_names(planes.count, plane, before and before.association)
    association = PlaneAssociation(names, plane, sheets=(0,) if any(sheets) else ())
    return AssociatedPlanes(association, planes.planes.copy(), _doubled(planes, thinned, search))


def _doubled(planes: ExtractedPlanes, clouds: Sequence[tuple[np.ndarray, np.ndarray]], search: PlaneSearch) -> float:
    """The largest share, over LiDARs, of points seen through other planes. clouds: points and origins of each LiDAR,
    of which some MOST_TRACED points are traced."""
    steps = [len(points) // MOST_TRACED | 1 for points, _ in clouds]
    traced = [(points[::k], origins[::k]) for (points, origins), k in zip(clouds, steps, strict=True)]
    return max(planes.share_seen_through(*cloud, planes.of_points(*cloud, search), search) for cloud in traced)


def association_of_streams(streams: Sequence[LidarStream]) -> PlaneAssociation:
    """The association that the streams contain, without planes of fewer than MIN_PLANE_POINTS points."""
    n_planes = max((int(s.plane.max(initial=-1)) for s in streams), default=-1) + 1
    count = sum((count_points(s.plane, n_planes) for s in streams), np.zeros(n_planes, dtype=np.int64))
    used = np.flatnonzero(count >= MIN_PLANE_POINTS)
    index = np.full(n_planes + 1, -1, dtype=np.int32)
    index[used] = np.arange(len(used))
    return PlaneAssociation(tuple(f"plane {k}" for k in used), tuple(index[s.plane] for s in streams))


def _every(step: int, stream: LidarStream) -> LidarStream:
    """The stream with every `step`th point."""
    return stream.numbered(np.arange(0, len(stream.xyz), step)) if step > 1 else stream


def odd_step(points: int, most: int = MOST_POINTS) -> int:
    """Odd step that thins `points` points to at most `most`. An even step would select only some lasers of a spinning
    LiDAR."""
    return -(-points // most) | 1


def _plane_of_points(
    surfaces: tuple[ExtractedPlanes, TargetSheet | None],
    motion: EstimatedMotion,
    stream: LidarStream,
    search: PlaneSearch,
) -> np.ndarray:
    """(N,) int32 plane of each point, -1: none; see `ExtractedPlanes.of_points`. The sheet has the number after the
    planes. The points are moved to the world group by group, which bounds the memory."""
    plane, (planes, sheet) = np.full(len(stream.xyz), -1, np.int32), surfaces

    def number(group: slice, points: np.ndarray, origins: np.ndarray) -> None:
        of_point = planes.of_points(points, origins, search)
        if sheet is not None:
            kinds = sheet.of_points(points, origins, search)
            of_point[kinds > 0] = -1
            of_point[kinds == ON_SHEET] = planes.count
        plane[group] = of_point

    each_in_world(motion, stream, number)
    return plane


def _plane_names(count: int, plane: tuple[np.ndarray, ...], before: PlaneAssociation | None) -> tuple[str, ...]:
    """A name for each of `count` planes: that of the plane in `before` with which it shares most points, else a new
    one. plane: for each LiDAR, the plane (N,) of its points."""
    if before is None:
        return tuple(f"plane {k}" for k in range(count))
    shared = np.zeros((count, len(before.names)), dtype=np.int64)
    for now, then in zip(plane, before.plane, strict=True):
        both = (now >= 0) & (now < count) & (then >= 0) & (then < len(before.names))
        shared += np.bincount(now[both] * np.int64(len(before.names)) + then[both], minlength=shared.size).reshape(
            shared.shape
        )
    total, names = shared.sum(axis=1), [""] * count
    for flat in np.argsort(-shared, axis=None, kind="stable"):
        q, k = divmod(int(flat), len(before.names))
        name = before.names[k]
        if not names[q] and name not in names and shared[q, k] > MIN_KEPT_POINTS * total[q]:
            names[q] = name
    number = 1 + max(int(name.removeprefix("plane ")) for name in before.names)
    for q in range(count):
        if not names[q]:
            names[q], number = f"plane {number}", number + 1
    return tuple(names)
