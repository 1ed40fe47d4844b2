"""Initial guess of LiDARs beside cameras that see a target, standing still: each stop is a pose, its cloud a snapshot.

The camera shows where the sheet of the target is at each stop. In each cloud, flat clusters of about the size of the
sheet are candidates for it. Two stops with a candidate each give a pose of the LiDAR, from centres and normals. The one
that explains most stops is the guess, and a fit of the points to the sheets refines it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from icalib.base.remark import Remark
from icalib.data.measurements import CornerStream, LidarStream, Measurements
from icalib.data.stamps import stands_still_between
from icalib.errors import EstimationError
from icalib.estimate.inputs import Inputs, inputs_for, with_association
from icalib.estimate.problem import keyframe_times, keyframes_for, start_values
from icalib.geometry import so3
from icalib.geometry.targets.base import BOARD
from icalib.initialize.initializer import InitialGuess, Values, stated_values
from icalib.initialize.smooth_trajectory import BodyPoses, Differ, changes, common_stops, follow_closely
from icalib.motion.factor import Extrinsics
from icalib.motion.point_planes import AT_REST
from icalib.optim.state import State, in_recording
from icalib.rig import Lidar, Rig
from icalib.sensors.lidar.board_factor import RIM_M
from icalib.sensors.lidar.initialize.registration import cell_centroids
from icalib.sensors.parameter import fixed

# Flat clusters of about the size of a sheet.

NEIGHBOUR_SHARE = 0.35  # of the sheet's shorter side: a neighbour is nearer. Rings must be closer together on the sheet
CELL_SHARE = 0.25  # edge of the cells whose centroids stand for their points, over the distance of neighbours
FLAT_M = 0.04  # largest distance between neighbours along the normal: twice the usual range noise
SAME_NORMAL = np.cos(np.deg2rad(25.0))  # of neighbours; normals of a few noisy points are that inaccurate
FEWEST_CELLS = 8
SIZE_RATIO = (0.5, 1.35)  # spread of a cluster over that of the sheet, along both of its axes


@dataclass(frozen=True)
class FlatClusters:
    """Flat clusters of one cloud. centre (c, 3) m; normal (c, 3): towards the LiDAR."""

    centre: np.ndarray
    normal: np.ndarray


def sheet_like(xyz: np.ndarray, size: np.ndarray) -> FlatClusters:
    """The clusters of a cloud xyz (N, 3) that are flat and about as large as a sheet of `size` (2,) m."""
    reach = NEIGHBOUR_SHARE * float(size.min())
    centre = cell_centroids(xyz, CELL_SHARE * reach)
    pairs = KDTree(centre).query_pairs(reach, output_type="ndarray")
    normal = _normals(centre, pairs)
    a, b = pairs.T
    apart = centre[b] - centre[a]
    flat = np.abs((apart * normal[a]).sum(axis=1)) < FLAT_M
    flat &= np.abs((apart * normal[b]).sum(axis=1)) < FLAT_M
    flat &= np.abs((normal[a] * normal[b]).sum(axis=1)) > SAME_NORMAL
    graph = coo_array((np.ones(flat.sum()), (a[flat], b[flat])), shape=(len(centre), len(centre)))
    n, label = connected_components(graph, directed=False)
    sheets = [
        c
        for k in np.flatnonzero(np.bincount(label, minlength=n) >= FEWEST_CELLS)
        if (c := _sheet(centre[label == k], size)) is not None
    ]
    centres, normals = (np.array([c[k] for c in sheets]).reshape(-1, 3) for k in range(2))
    return FlatClusters(centres, normals)


def _normals(points: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """(n, 3) normals of the surface at points (n, 3), from neighbours in pairs (m, 2)."""
    n, (a, b) = len(points), pairs.T
    ends = coo_array((np.ones(2 * len(a) + n), (np.r_[a, b, :n], np.r_[b, a, :n])), shape=(n, n)).tocsr()
    total = ends @ np.ones(n)
    mean = (ends @ points) / total[:, None]
    squares = (points[:, :, None] * points[:, None, :]).reshape(n, 9)
    spread = (ends @ squares) / total[:, None] - (mean[:, :, None] * mean[:, None, :]).reshape(n, 9)
    return np.linalg.eigh(spread.reshape(n, 3, 3))[1][:, :, 0]


def _sheet(points: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Centre and normal of a cluster of points (n, 3), if it is as large as a sheet of `size` (2,) m; else None."""
    centre = points.mean(axis=0)
    variance, axes = np.linalg.eigh(np.cov(points.T))
    ratio = np.sqrt(12.0 * variance[1:]) / np.sort(size)
    if ratio.min() < SIZE_RATIO[0] or ratio.max() > SIZE_RATIO[1]:
        return None
    normal = axes[:, 0]
    return centre, -np.copysign(1.0, normal @ centre) * normal


# The pose of the LiDAR that explains most stops.

LARGEST_TURN = np.deg2rad(15.0)  # between the normal of a cluster and that of the sheet
SHIFT_SHARE = 0.35  # of the sheet's shorter side: distance between the centres of a cluster and the sheet
MOST_PAIRS = 300  # pairs of stops that are tried
FEWEST_STOPS = 3  # two define the pose; the third confirms it
FIT_ROUNDS = 20
FIT_GATE_M = 0.1  # of points from their sheet; the range offset of LiDARs is below
CENTRE_SIGMA_M, POINT_SIGMA_M = 0.1, 0.02  # of a cluster's centre, which rings sample, and of a point on the sheet


@dataclass(frozen=True)
class Sheets:
    """The sheet at each stop, in the body's frame. rotation (k, 3, 3): axes of the sheet, z out of the print; centre
    (k, 3) m. size (2,) m."""

    rotation: np.ndarray
    centre: np.ndarray
    size: np.ndarray

    @property
    def normal(self) -> np.ndarray:
        return self.rotation[:, :, 2]


def pose_by_sheets(sheets: Sheets, clouds: Sequence[np.ndarray]) -> tuple[Extrinsics, int] | None:
    """Pose of the LiDAR in the body's frame from a cloud (N, 3) at each stop, and the number of stops that it explains.
    None if there is none."""
    clusters = [sheet_like(cloud, sheets.size) for cloud in clouds]
    best: tuple[float, Extrinsics] | None = None
    pairs = [*combinations([k for k, c in enumerate(clusters) if len(c.centre)], 2)]
    order = np.random.default_rng(0).permutation(len(pairs))[:MOST_PAIRS]
    for i, j in (pairs[k] for k in order):
        for pose in _hypotheses(sheets, clusters, i, j):
            score = _score(sheets, clusters, pose).sum()
            if best is None or score > best[0]:
                best = score, pose
    if best is None:
        return None
    pose = _fit(sheets, clouds, best[1])
    explained = int((_score(sheets, clusters, pose) > 0.0).sum())
    return (pose, explained) if explained >= FEWEST_STOPS else None


def _hypotheses(sheets: Sheets, clusters: Sequence[FlatClusters], i: int, j: int) -> list[Extrinsics]:
    """Poses of the LiDAR for each pair of clusters at stops i and j that are placed to each other as the sheets are."""
    a, b = (x.ravel() for x in np.indices((len(clusters[i].centre), len(clusters[j].centre))))
    line = sheets.centre[j] - sheets.centre[i]
    lines = clusters[j].centre[b] - clusters[i].centre[a]
    normals = clusters[i].normal[a], clusters[j].normal[b]
    tolerance = SHIFT_SHARE * float(sheets.size.min())
    alike = np.abs(np.linalg.norm(lines, axis=1) - np.linalg.norm(line)) < tolerance
    turn = np.arccos(np.clip((normals[0] * normals[1]).sum(axis=1), -1.0, 1.0))
    alike &= np.abs(turn - np.arccos(np.clip(sheets.normal[i] @ sheets.normal[j], -1.0, 1.0))) < LARGEST_TURN
    for k, n in zip((i, j), normals, strict=True):
        alike &= np.abs((lines * n).sum(axis=1) - line @ sheets.normal[k]) < tolerance
    out = []
    for k in np.flatnonzero(alike):
        of_body = np.stack([sheets.normal[i], sheets.normal[j], line])
        of_lidar = np.stack([normals[0][k], normals[1][k], lines[k]])
        R = _kabsch(of_lidar, of_body)
        middle = 0.5 * (clusters[i].centre[a[k]] + clusters[j].centre[b[k]])
        out.append(Extrinsics(R, 0.5 * (sheets.centre[i] + sheets.centre[j]) - R @ middle))
    return out


def _kabsch(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(3, 3) rotation that best turns vectors a (n, 3) into b (n, 3)."""
    u, _, vt = np.linalg.svd(b.T @ a)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _score(sheets: Sheets, clusters: Sequence[FlatClusters], pose: Extrinsics) -> np.ndarray:
    """(k,) agreement of the best cluster of each stop with the sheet, from 0: none to 1."""
    out = np.zeros(len(clusters))
    for k, c in enumerate(clusters):
        if len(c.centre):
            shift = np.linalg.norm(c.centre @ pose.R.T + pose.p - sheets.centre[k], axis=1)
            turn = np.arccos(np.clip(c.normal @ pose.R.T @ sheets.normal[k], -1.0, 1.0))
            misfit = (shift / (SHIFT_SHARE * sheets.size.min())) ** 2 + (turn / LARGEST_TURN) ** 2
            out[k] = max(0.0, 1.0 - misfit.min())
    return out


def _fit(sheets: Sheets, clouds: Sequence[np.ndarray], pose: Extrinsics) -> Extrinsics:
    """The pose at which points lie best on the sheets, and their centres in the middle, by Gauss-Newton steps."""
    half = 0.5 * sheets.size - RIM_M
    for _ in range(FIT_ROUNDS):
        H, g = np.zeros((6, 6)), np.zeros(6)
        for R_sheet, centre, cloud in zip(sheets.rotation, sheets.centre, clouds, strict=True):
            y = (cloud @ pose.R.T + pose.p - centre) @ R_sheet
            on = (np.abs(y[:, :2]) < half).all(axis=1) & (np.abs(y[:, 2]) < FIT_GATE_M)
            if not on.any():
                continue
            x, axes = cloud[on], R_sheet.T @ pose.R
            J = np.concatenate([np.cross(x[:, None, :], axes[None]), np.tile(axes, (len(x), 1, 1))], axis=2)
            plane, middle = J[:, 2] / POINT_SIGMA_M, J[:, :2].mean(axis=0) / CENTRE_SIGMA_M
            H += plane.T @ plane + middle.T @ middle
            g += plane.T @ y[on, 2] / POINT_SIGMA_M + middle.T @ y[on, :2].mean(axis=0) / CENTRE_SIGMA_M
        step = -np.linalg.lstsq(H, g, rcond=None)[0]
        pose = Extrinsics(pose.R @ so3.exp(step[:3]), pose.p + pose.R @ step[3:])
    return pose


# The whole guess of a rig at rest.

SAME_STOP_SHARE = 0.2  # of the time between stops: images and clouds nearer in time belong to the same stop


def stands_still(rig: Rig, body: Sequence[BodyPoses]) -> bool:
    """Whether the rig has only cameras and LiDARs, and stands still at each pose of its body."""
    others = {s.sensor_type for s in rig.mounted} - {"camera", "lidar"}
    return not others and all(stands_still_between(p.seconds, p.rotation, p.position) for p in body)


def guess_at_rest(
    rig: Rig, recordings: Sequence[Measurements], body: Sequence[BodyPoses], values: Values
) -> InitialGuess:
    """The initial guess from poses of the body at stops, and the values of the cameras. Raises EstimationError if the
    target is not found in the clouds of a LiDAR."""
    known = [replace(s, time_offset=fixed(np.zeros(1)), clock_restarts=False) for s in rig.lidars]
    still = rig.with_sensors(*known)
    at_stops = [_at_stops(m, poses) for m, poses in zip(recordings, body, strict=True)]
    inputs = with_association(replace(inputs_for(still, at_stops), user_rig=rig), AT_REST)
    values = values | {(BOARD, "tilt"): np.eye(3)}
    for k in range(len(recordings)):
        values |= {(in_recording(BOARD, k), "tilt"): np.eye(3)}
    for sensor in still.lidars:
        values |= _extrinsics(inputs, sensor, at_stops, body) | stated_values(inputs, sensor)
    values = start_values(inputs, values)
    keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
    t = np.concatenate([p.seconds + part.begin for p, part in zip(body, inputs.parts, strict=True)])
    k = np.searchsorted(0.5 * (t[1:] + t[:-1]), keyframes)
    R, p = (np.concatenate([getattr(poses, name) for poses in body])[k] for name in ("rotation", "position"))
    n = len(keyframes)
    state = State(keyframes, np.ascontiguousarray(R), p, np.zeros((n, 3)), np.zeros((n, 6)), values)
    return replace(inputs, guess=state), state, state.values


def _at_stops(m: Measurements, body: BodyPoses) -> Measurements:
    """The recording with the scans that were taken at a stop, at the time of the pose of the body there."""
    for stream in m.lidars:
        seconds = (stream.stamps_ns - m.origin_ns) * 1e-9
        k = np.searchsorted(0.5 * (body.seconds[1:] + body.seconds[:-1]), seconds)
        apart = np.abs(seconds - body.seconds[k])
        stop_s = float(np.median(np.diff(body.seconds))) if len(body.seconds) > 1 else np.inf
        near = np.flatnonzero(apart < SAME_STOP_SHARE * stop_s)
        near = near[np.lexsort((apart[near], k[near]))]
        near = np.sort(near[np.unique(k[near], return_index=True)[1]])  # the nearest of each stop
        kept = np.zeros(len(stream.stamps_ns), bool)
        kept[near] = True
        stamps_ns = m.origin_ns + np.round(body.seconds[k[near]] * 1e9).astype(np.int64)
        m = m.with_streams(stream.of_scans(kept, stamps_ns))
    return m


def _extrinsics(inputs: Inputs, sensor: Lidar, recordings: Sequence[Measurements], body: Sequence[BodyPoses]) -> Values:
    """Extrinsics of a LiDAR by the reference body of the target. Raises EstimationError if none are found."""
    low, high = inputs.bodies.target.outlines[inputs.bodies.used[0]]
    middle, rotation, centre, clouds = np.append(0.5 * (low + high), 0.0), [], [], []
    for m, poses in zip(recordings, body, strict=True):
        stream: LidarStream = m.streams[sensor.name]  # pyright: ignore[reportAssignmentType]
        seconds = (stream.stamps_ns - m.origin_ns) * 1e-9
        stops = np.searchsorted(poses.seconds, seconds - 1e-6)
        for k, (a, b) in zip(stops, pairwise(stream.start.tolist()), strict=True):
            R = poses.rotation[k].T
            rotation.append(R)
            centre.append(R @ (middle - poses.position[k]))
            clouds.append(stream.xyz[a:b].astype(np.float64))
    if len(clouds) < FEWEST_STOPS:
        raise EstimationError(
            f"{sensor.name}: clouds of {len(clouds)} stops at which the cameras see the target are too few, at least "
            f"{FEWEST_STOPS} are needed; record more stops, with the board tilted differently at each."
        )
    sheets = Sheets(np.array(rotation), np.array(centre), high - low)
    best = pose_by_sheets(sheets, clouds)
    if best is None:
        raise EstimationError(
            f"{sensor.name}: the target was not found in its {len(clouds)} clouds: no flat object of "
            f"{sheets.size[0]:.2f} x {sheets.size[1]:.2f} m moves as in the images. Check `sheet` of the target "
            "in the rig file, and hold the board where both sensors see it, away from walls."
        )
    pose, _ = best
    return {(sensor.name, "rotation"): pose.R, (sensor.name, "translation"): pose.p}


# Recordings that go on while the board is carried from place to place.

CELL_DEG = 3.0  # of azimuth and elevation: a few beams of a spinning LiDAR
STATIC_PAIRS = 12  # of clouds that are compared
_FAR_NS = 10**18  # no recording is that long
STATIC_RATIO = 2.0  # of the changes between clouds far apart and successive ones: 1 of a LiDAR that stands still


def at_places(rig: Rig, recordings: Sequence[Measurements]) -> Sequence[Measurements]:
    """The recordings with an image and a cloud of each place at which the board was at rest, if images follow one
    another while the LiDAR stands still. Raises EstimationError if these places are too few."""
    others = {s.sensor_type for s in rig.mounted} - {"camera", "lidar"}
    if others or not (rig.cameras and rig.lidars):
        return recordings
    carried = [_carries_a_board(m) for m in recordings]
    stops = [
        common_stops([(s.stamps_ns, s.by_point()) for s in m.cameras]) if k else None
        for m, k in zip(recordings, carried, strict=True)
    ]
    count = sum(len(k) for k in stops if k is not None)
    if all(carried) and count < FEWEST_STOPS:
        raise EstimationError(
            f"{rig.lidars[0].name} stands still, and the cameras see the target at rest in only {count} of the at "
            f"least {FEWEST_STOPS} places that are needed; hold the board still for two seconds at each of ten places."
        )
    return [m if k is None else noting_stops(reduced(m, k)) for m, k in zip(recordings, stops, strict=True)]


def _carries_a_board(m: Measurements) -> bool:
    """Whether images follow one another while the first LiDAR stands still."""
    return bool(m.cameras) and all(follow_closely(s.stamps_ns) for s in m.cameras) and sees_the_same(m.lidars[0])


def sees_the_same(stream: LidarStream) -> bool:
    """Whether the view of a LiDAR hardly changes, or its clouds do not follow one another."""
    if not follow_closely(stream.stamps_ns):
        return True
    k = np.linspace(0, len(stream.stamps_ns) - 2, STATIC_PAIRS).astype(int)
    scans = np.unique(np.concatenate([k, k + 1]))
    differ = cloud_changes(stream, scans)
    i, j = np.searchsorted(scans, k), np.searchsorted(scans, np.roll(k, len(k) // 2))
    return bool(np.median(differ(i, j)) < STATIC_RATIO * np.median(differ(i, i + 1)))


def cloud_changes(stream: LidarStream, scans: np.ndarray) -> Differ:
    """Differences [m] of the clouds `scans`: the median over directions of the change of the mean range."""
    n_azimuth, n_elevation = round(360.0 / CELL_DEG), round(180.0 / CELL_DEG)
    ranges = np.full((len(scans), n_azimuth * n_elevation, 1), np.nan, np.float32)
    for row, k in zip(ranges[:, :, 0], scans, strict=True):
        x, y, z = stream.xyz[stream.start[k] : stream.start[k + 1]].T
        azimuth = (np.rad2deg(np.arctan2(y, x)) + 180.0) / CELL_DEG
        elevation = (np.rad2deg(np.arctan2(z, np.hypot(x, y))) + 90.0) / CELL_DEG
        cell = np.minimum(elevation.astype(int), n_elevation - 1) * n_azimuth + azimuth.astype(int) % n_azimuth
        count = np.bincount(cell, minlength=len(row))
        total = np.bincount(cell, np.sqrt(x * x + y * y + z * z), minlength=len(row))
        row[count > 0] = total[count > 0] / count[count > 0]
    return changes(ranges)


def reduced(m: Measurements, stops: np.ndarray) -> Measurements:
    """The recording with the image of each camera and the cloud of each LiDAR that are nearest to the middle of each of
    `stops` (k, 2) [ns], stamped as the first of these sensors has it. Raises EstimationError if a sensor has none."""
    middle = stops[:, 0] + (stops[:, 1] - stops[:, 0]) // 2
    stamps_ns, streams = middle.copy(), (*m.cameras, *m.lidars)
    for stream in streams:
        empty = np.diff(stream.start) == 0
        chosen = np.argmin(np.abs(stream.stamps_ns - middle[:, None]) + empty * _FAR_NS, axis=1)
        at = stream.stamps_ns[chosen]
        inside = (at >= stops[:, 0]) & (at <= stops[:, 1]) & ~empty[chosen]
        if not inside.any():
            raise EstimationError(
                f"{stream.name} has no image or cloud of the stops that {streams[0].name} shows, by numbers or stamps; "
                "give what belongs to a stop the same number, or record all sensors by one clock."
            )
        if stream is streams[0]:
            stamps_ns[inside] = at[inside]
        m = m.with_streams(_at(stream, chosen[inside], stamps_ns[inside]))
    return m


def noting_stops(m: Measurements) -> Measurements:
    """The recording with a note on the stops that it has been reduced to."""
    n = max(len(s.stamps_ns) for s in m.lidars)
    words = f"stops found: {n}. Of each, what a sensor measured in its middle is used. No time_offset is estimated."
    return replace(m, notes=(*m.notes, Remark("stops_found", words)))


def _at(stream: CornerStream | LidarStream, which: np.ndarray, stamps_ns: np.ndarray) -> CornerStream | LidarStream:
    """The images or clouds `which` (k,), each taken at one instant of `stamps_ns` (k,)."""
    if isinstance(stream, CornerStream):
        rows = np.flatnonzero(np.isin(stream.image, which))
        return stream.of_rows(rows, stamps_ns, np.diff(stream.start)[which])
    scans = stream.of_scans(np.isin(np.arange(len(stream.stamps_ns)), which), stamps_ns)
    return replace(scans, offset_s=np.zeros_like(scans.offset_s))
