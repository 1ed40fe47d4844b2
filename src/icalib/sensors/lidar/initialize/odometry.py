"""LiDAR odometry: each scan is registered to a map of planar voxels built from the previous scans.

A scan has a pose at its middle and a twist, from which the pose at the instant of each point follows. Without gyroscope
the twist also describes the rotation within a scan. Once the LiDAR is aligned with the IMU, the gyroscope gives the
rotation within a scan and predicts the rotation since the previous scan.

Compiled registration of a scan to a map of planar voxels, near the pose predicted from the previous scan.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.data.measurements import LidarStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.small import mul3, solve_definite, tmul3
from icalib.initialize.trajectories import SensorTrajectory
from icalib.optim.arrowhead import N_THREADS
from icalib.sensors.lidar.initialize.voxel_map import (
    N_SCAN_UNKNOWNS,
    ScanPose,
    VoxelMap,
    accumulate_scan,
    corrected_pose,
    insert,
    pick_points,
    rotate_points,
)

# Points of a scan:
MAX_MATCHED_POINTS, MAX_MAPPED_POINTS = 1500, 6000  # registered to the map, and added to it
MAX_NEIGHBOUR_POINTS = 500  # used in steps that search 27 voxels for each point
MIN_SCAN_POINTS = 100  # scans with fewer points are not used
MIN_ODOMETRY_RANGE_M = 0.3  # nearer points lie on the housing of the LiDAR
GOLDEN_RATIO = 0.6180339887498949  # step as a share of all points: any number of such steps covers a scan evenly
MIN_SCANS = 20  # in a recording
# The map:
VOXELS_PER_MEDIAN_RANGE = 8.0  # median range of points, in edges of a voxel
VOXEL_EDGE_RANGE_M = (0.3, 2.0)  # shortest and longest edge
MAX_VOXELS = 1 << 17  # 25 MB
SCAN_DECAY, SCAN_DECAY_WITH_GYRO = (
    0.85,
    0.995,
)  # factor of the weight of old points per scan; odometry drifts faster without gyroscope
# Scale of the robust weights in the last step, in edges of a voxel.
FINAL_SCALE, FINAL_SCALE_WITH_GYRO = 0.2, 0.1
MIN_SHARE_NEAR_MAP = 0.3  # share of the matched points near planes of the map; a scan with fewer does not fit
MAX_LOST_SCANS = 5  # in a row that do not fit, before a new map starts
MIN_MAP_SCANS = 10  # that fit a map; a single map with fewer is discarded, as its first scan showed too little
FIRST_TWIST_ROUNDS = 4  # to estimate the twist of the first scan of a map
# Two halves on two threads:
MIN_SCANS_FOR_TWO_MAPS = 200  # in a recording; for fewer the cost of a second map exceeds the gain
OVERLAP_SCANS, MIN_OVERLAP_SCANS = 20, 5  # scans in both maps, and least number that fits both, to join the maps
# Points of single rings, see `_share_on_lines`:
MAX_SHARE_ON_LINES = 0.8  # of the points; a scan with a larger share shows no surfaces
MIN_LINE_POINTS, MAX_LINE_WIDTH = 5, 0.25  # points of a line in a voxel; width as a share of the length
GYRO_STEP_S = 1e-3  # between rotations by the gyroscope within a scan
MAX_SCAN_STEP_S = 1.0  # between scans, over which the twist is extrapolated

RotationAt = Callable[[np.ndarray], np.ndarray]  # instants (n,) on the LiDAR's clock -> R_start_lidar (n, 3, 3)
PositionAt = Callable[[np.ndarray], np.ndarray]  # instants (n,) -> approximate p_start_lidar (n, 3) [m]


@dataclass(frozen=True)
class Scan:
    """Points sampled from a scan. middle [s]: instant on the LiDAR's clock; xyz (n, 3) [m]; tau (n,): time of each
    point since the middle [s]. Any first few points are spread over the scan."""

    middle: float
    xyz: np.ndarray
    tau: np.ndarray


def sampled_scans(stream: LidarStream) -> list[Scan]:
    """Scans with at most MAX_MAPPED_POINTS points each, without scans of few points. Raises EstimationError if there
    are too few scans."""
    with ThreadPoolExecutor(N_THREADS) as pool:
        scans = list(pool.map(lambda i: _sampled_scan(stream, i), range(len(stream.stamps_ns))))
    scans = [s for s in scans if len(s.tau) >= MIN_SCAN_POINTS]
    if len(scans) < MIN_SCANS:
        raise EstimationError(
            f"{stream.name}: {len(scans)} of {len(stream.stamps_ns)} usable scans have {MIN_SCAN_POINTS} points or "
            f"more, and {MIN_SCANS} are needed; check its topic, or record for longer."
        )
    return scans


def lidar_trajectory(
    name: str,
    scans: list[Scan],
    rotation_at: RotationAt | None = None,
    position_at: PositionAt | None = None,
    single_map: bool = True,
    shares: tuple[float, ...] = (0.0,),
) -> SensorTrajectory:
    """Scan-to-map odometry of LiDAR `name`: poses in the frame of the map, at the middles of scans, or `shares` of the
    duration of a scan before and after them.

    rotation_at, position_at: known rotations, and approximate positions. single_map: one map for all scans; scans
    before it that fit no map are not ok. Otherwise a new map starts if the LiDAR is lost. Scans within MAX_SCAN_STEP_S
    after the last good one are then not ok, so that no step connects two maps.

    Raises EstimationError if more than half of the scans fit no map.
    """
    seconds = np.array([s.middle for s in scans])
    known = _KnownSteps.of(seconds, rotation_at, position_at)
    if rotation_at is not None:
        scans = [_rotated_to_middle(s, rotation_at) for s in scans]
    median_range = float(np.median([np.median(np.linalg.norm(s.xyz, axis=1)) for s in scans]))
    edge_m = float(np.clip(median_range / VOXELS_PER_MEDIAN_RANGE, *VOXEL_EDGE_RANGE_M))
    poses, ok = (_track_in_single_map if single_map else _track_in_several_maps)(scans, known, edge_m)
    if ok.mean() < 0.5:
        raise EstimationError(
            f"{name}: only {ok.sum()} of {len(scans)} scans match the surfaces of other scans; "
            f"{_mismatch_cause(scans, edge_m)}."
        )
    aside = np.array([np.ptp(s.tau) for s in scans])[:, None] * np.array(shares)  # (scans, shares) from the middles [s]
    R, p, rate, velocity = (np.repeat([getattr(x, f) for x in poses], len(shares), axis=0) for f in ScanPose._fields)
    step = aside.reshape(-1, 1)
    return SensorTrajectory(
        (seconds[:, None] + aside).ravel(), R @ so3.exp_many(step * rate), p + step * velocity, ok.repeat(len(shares))
    )


def _mismatch_cause(scans: list[Scan], edge_m: float) -> str:
    """Cause of the mismatch of scans, and advice, as text."""
    if (share := np.median([_share_on_lines(scan, edge_m) for scan in scans])) <= MAX_SHARE_ON_LINES:
        return "there may be too few flat surfaces, or the point times may be wrong"
    return (
        f"{share:.0%} of the points of a scan lie on single rings, {edge_m:.1g} m and more apart, so "
        "that a scan shows no surfaces; record at the full resolution of the LiDAR, or use one with "
        "more rings"
    )


def _share_on_lines(scan: Scan, edge_m: float) -> float:
    """Share of the points in voxels whose points form a line, as the points of a single ring do. Voxels with fewer than
    MIN_LINE_POINTS points are ignored."""
    _, voxel, count = np.unique(np.floor(scan.xyz / edge_m), axis=0, return_inverse=True, return_counts=True)
    voxel = voxel.ravel()
    mean = np.stack([np.bincount(voxel, x) for x in scan.xyz.T], axis=1) / count[:, None]
    off = scan.xyz - mean[voxel]
    spread = np.array([[np.bincount(voxel, a * b) for a in off.T] for b in off.T]).transpose(2, 0, 1)
    size = np.sqrt(np.maximum(np.linalg.eigvalsh(spread), 0.0))
    used = count >= MIN_LINE_POINTS
    line = used & (size[:, 1] < MAX_LINE_WIDTH * size[:, 2])
    return float(count[line].sum() / max(count[used].sum(), 1))


def _sampled_scan(stream: LidarStream, i: int) -> Scan:
    """Scan i of the stream, thinned."""
    rows = slice(int(stream.start[i]), int(stream.start[i + 1]))
    offset, xyz = stream.offset_s[rows], stream.xyz[rows]
    if not len(offset):
        return Scan(float(stream.seconds[i]), np.empty((0, 3)), np.empty(0))
    middle = 0.5 * (float(offset.min()) + float(offset.max()))
    chosen = evenly_spread(len(offset), MAX_MAPPED_POINTS, i)
    for part in np.split(chosen, (MAX_NEIGHBOUR_POINTS, MAX_MATCHED_POINTS)):
        part.sort()  # successive points mostly share a voxel, which is then in the processor cache
    points, tau = np.empty((len(chosen), 3)), np.empty(len(chosen))
    n = pick_points(xyz, offset, chosen, middle, MIN_ODOMETRY_RANGE_M, points, tau)
    return Scan(float(stream.seconds[i]) + middle, points[:n], tau[:n])


def evenly_spread(n: int, most: int, begin: int) -> np.ndarray:
    """(min(n, most),) different indices below n, evenly spread, starting with `begin` modulo n. Any first few of them
    are evenly spread as well."""
    step = max(int(GOLDEN_RATIO * n), 1)
    while np.gcd(step, n) > 1:
        step += 1
    return (begin + np.arange(min(n, most)) * step) % n


def _rotated_to_middle(scan: Scan, rotation_at: RotationAt) -> Scan:
    """The scan with its points rotated into the axes of the LiDAR at the middle of the scan."""
    which = np.floor(scan.tau / GYRO_STEP_S).astype(np.int64)
    low = which.min()
    steps = scan.middle + (np.arange(low, which.max() + 1) + 0.5) * GYRO_STEP_S
    R = rotation_at(np.append(steps, scan.middle))
    xyz = scan.xyz.copy()
    rotate_points(xyz, which - low, np.ascontiguousarray(R[-1].T @ R[:-1]))
    return Scan(scan.middle, xyz, scan.tau)


@dataclass(frozen=True)
class _KnownSteps:
    """Known motion from the previous scan to each of n scans, None if unknown: rotation R_before_scan (n, 3, 3),
    translation p_before_scan (n, 3) [m]. The step of the first scan is zero."""

    rotation: np.ndarray | None
    translation: np.ndarray | None

    @classmethod
    def of(cls, seconds: np.ndarray, rotation_at: RotationAt | None, position_at: PositionAt | None) -> _KnownSteps:
        """Steps between scans with middles at `seconds` (n,) on the LiDAR's clock."""
        if rotation_at is None:
            return cls(None, None)
        R = rotation_at(seconds)
        back = np.concatenate([R[:1], R[:-1]]).transpose(0, 2, 1)
        step = None if position_at is None else np.diff(p := position_at(seconds), axis=0, prepend=p[:1])
        return cls(back @ R, None if step is None else np.einsum("nij,nj->ni", back, step))

    def part(self, scans: slice) -> _KnownSteps:
        """The steps of a slice of the scans."""
        return _KnownSteps(*(None if x is None else x[scans] for x in (self.rotation, self.translation)))


def _track_in_several_maps(scans: list[Scan], known: _KnownSteps, edge_m: float) -> tuple[list[ScanPose], np.ndarray]:
    """Poses, and a mask (n,) of valid ones, in as many maps as needed. Halves of a long recording run on two
    threads."""
    n, seconds = len(scans), np.array([s.middle for s in scans])
    parts = [slice(0, n)] if n < MIN_SCANS_FOR_TWO_MAPS else [slice(0, n // 2), slice(n // 2, n)]
    tracks = _track_parts(scans, known, edge_m, parts, False)
    ok = np.concatenate([fits for _, fits in tracks])
    for part in parts[1:]:
        ok[part] &= seconds[part] > seconds[part.start - 1] + MAX_SCAN_STEP_S
    return [pose for poses, _ in tracks for pose in poses], ok


def _track_in_single_map(scans: list[Scan], known: _KnownSteps, edge_m: float) -> tuple[list[ScanPose], np.ndarray]:
    """Poses, and a mask (n,) of valid ones, in one map. The halves of a long recording run on two threads, and are
    joined by the scans that both contain."""
    middle = len(scans) // 2
    if len(scans) >= MIN_SCANS_FOR_TWO_MAPS:
        parts = [slice(0, middle + OVERLAP_SCANS), slice(middle, len(scans))]
        (before, fits), (after, fits_after) = _track_parts(scans, known, edge_m, parts, True)
        both = np.flatnonzero(fits[middle:] & fits_after[:OVERLAP_SCANS])
        if len(both) >= MIN_OVERLAP_SCANS:
            joined = _joined([before[middle + k] for k in both], [after[k] for k in both], after[OVERLAP_SCANS:])
            return [*before, *joined], np.concatenate([fits, fits_after[OVERLAP_SCANS:]])
    return _MapTracker(scans, known, edge_m, True).track()


def _track_parts(
    scans: list[Scan], known: _KnownSteps, edge_m: float, parts: list[slice], single_map: bool
) -> list[tuple[list[ScanPose], np.ndarray]]:
    """Poses, and a mask of valid ones, for each part; one thread per part."""

    def track(part: slice) -> tuple[list[ScanPose], np.ndarray]:
        return _MapTracker(scans[part], known.part(part), edge_m, single_map).track()

    with ThreadPoolExecutor(len(parts)) as pool:
        return list(pool.map(track, parts))


def _joined(first: list[ScanPose], second: list[ScanPose], others: list[ScanPose]) -> list[ScanPose]:
    """Poses `others` in the second map, transformed to the first. first, second: poses of the same scans in the first
    and in the second map."""
    u, _, vt = np.linalg.svd(
        sum((a.rotation @ b.rotation.T for a, b in zip(first, second, strict=True)), np.zeros((3, 3)))
    )
    R = u @ vt  # chordal mean; its determinant is 1, as the rotations are near one another
    p = np.mean([a.position - R @ b.position for a, b in zip(first, second, strict=True)], axis=0)
    return [ScanPose(R @ x.rotation, p + R @ x.position, x.rate, R @ x.velocity) for x in others]


class _MapTracker:
    """Registers scans one after another to a map that grows with them; see `lidar_trajectory`."""

    def __init__(self, scans: list[Scan], known: _KnownSteps, edge_m: float, single_map: bool) -> None:
        self._scans, self._known, self._single_map = scans, known, single_map
        self._voxels = VoxelMap.empty(edge_m, MAX_VOXELS)
        self._fits = np.ones(len(scans), dtype=bool)  # the scan fits its map
        self._excluded = np.zeros(len(scans), dtype=bool)  # excluded from the trajectory, although it may fit
        self._excluded_until = -np.inf  # instant [s]

    def track(self) -> tuple[list[ScanPose], np.ndarray]:
        """Poses of the n scans, and a mask (n,) of valid ones."""
        gyro = self._known.rotation is not None
        scale, decay = (FINAL_SCALE_WITH_GYRO, SCAN_DECAY_WITH_GYRO) if gyro else (FINAL_SCALE, SCAN_DECAY)
        poses, lost = [self._start_map(0)], 0
        for k in range(1, len(self._scans)):
            pose = self._place(k, poses[-1], scale)
            lost = 0 if self._fits[k] else lost + 1
            if lost == MAX_LOST_SCANS and self._may_restart(k):
                self._exclude_before(k, lost)
                pose, lost = self._start_map(k), 0
            self._excluded[k] = self._scans[k].middle < self._excluded_until
            poses.append(pose)
            if self._fits[k]:
                self._insert(k, pose, decay)
        return poses, self._fits & ~self._excluded

    def _place(self, k: int, before: ScanPose, scale: float) -> ScanPose:
        """Pose of scan k, given the pose `before` of the previous scan. A scan that does not fit gets the predicted
        pose."""
        scan, known = self._scans[k], self._known
        step = scan.middle - self._scans[k - 1].middle
        rotation, translation = (None if x is None else x[k] for x in (known.rotation, known.translation))
        prediction = PosePrediction.of(before, min(step, MAX_SCAN_STEP_S), rotation, translation)
        xyz, tau = scan.xyz[:MAX_MATCHED_POINTS], scan.tau[:MAX_MATCHED_POINTS]
        pose, near = register(self._voxels, xyz, tau, MAX_NEIGHBOUR_POINTS, prediction, scale)
        self._fits[k] = near > MIN_SHARE_NEAR_MAP * len(tau)
        return pose if self._fits[k] else predicted_pose(prediction)

    def _start_map(self, k: int) -> ScanPose:
        """Starts a new map from scan k, and returns its pose. Its twist is estimated by registering scan k + 1 to
        it."""
        still = ScanPose(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
        pose = still
        for _ in range(FIRST_TWIST_ROUNDS):
            self._voxels.clear()
            self._insert(k, pose, 1.0)
            after = self._place(k + 1, pose, FINAL_SCALE)
            pose = still._replace(rate=after.rate, velocity=after.velocity)
        return pose

    def _insert(self, k: int, pose: ScanPose, decay: float) -> None:
        """Adds scan k to the map."""
        insert(self._voxels, pose, self._scans[k].xyz, self._scans[k].tau, k, decay)

    def _may_restart(self, k: int) -> bool:
        """True if a new map may start at scan k: a scan follows it, and a single map still has few valid scans."""
        n_valid = np.count_nonzero((self._fits & ~self._excluded)[:k])
        return k + 1 < len(self._scans) and not (self._single_map and n_valid > MIN_MAP_SCANS)

    def _exclude_before(self, k: int, lost: int) -> None:
        """Excludes the scans of a discarded single map; with several maps, scans too soon after the last good one."""
        if self._single_map:
            self._excluded[:k] = True
        else:
            self._excluded_until = self._scans[k - lost].middle + MAX_SCAN_STEP_S


MAX_REGISTRATION_ROUNDS = 14  # Gauss-Newton steps of a scan
NEIGHBOUR_ROUNDS = 4  # first steps, which also search the neighbours of a voxel
FIRST_SCALE = 0.5  # scale of the robust weights in the first step, in edges of a voxel
CONVERGED_STEP = 1e-4  # rad, m: a smaller step ends the registration
POINT_SIGMA_M = 0.1  # sigma of a point relative to the prediction; above its noise, as errors of points are correlated
# Without gyroscope, for a handheld LiDAR: standard deviations of accelerations (rad/s^2, m/s^2), and of the difference
# between a step and the mean of the rates before and after it (rad, m).
ANGULAR_ACCELERATION_SIGMA, ACCELERATION_SIGMA = 6.0, 5.0
STEP_ROTATION_SIGMA, STEP_POSITION_SIGMA = 0.02, 0.02
# With gyroscope: standard deviations of its bias (rad/s), and of its rotation between scans (rad).
GYRO_RATE_SIGMA, GYRO_ROTATION_SIGMA = 0.01, 0.004
KNOWN_TRANSLATION_SIGMA = 0.03  # m between scans: rotation times the lever arm, which is not yet known


class PosePrediction(NamedTuple):
    """Prediction of a pose from the pose `before`, `step` seconds earlier. rotation: R_before_scan (3, 3), if known;
    translation (3,): from the previous scan to this one, in axes of the previous one [m], if known."""

    before: ScanPose
    step: float
    knows_rotation: bool
    rotation: np.ndarray
    knows_translation: bool
    translation: np.ndarray

    @classmethod
    def of(
        cls, before: ScanPose, step: float, rotation: np.ndarray | None, translation: np.ndarray | None
    ) -> PosePrediction:
        """Prediction with rotation and translation, each None if unknown."""
        return cls(
            before,
            step,
            rotation is not None,
            np.eye(3) if rotation is None else np.ascontiguousarray(rotation),
            translation is not None,
            np.zeros(3) if translation is None else np.ascontiguousarray(translation),
        )


@njit(cache=True, nogil=True)
def _displacement(prediction):
    """(3,) predicted translation since the previous scan, in axes of the map [m]."""
    before, translation = prediction.before, prediction.translation
    out = np.empty(3)
    for i in range(3):
        R = before.rotation[i]
        known = R[0] * translation[0] + R[1] * translation[1] + R[2] * translation[2]
        out[i] = known if prediction.knows_translation else before.velocity[i] * prediction.step
    return out


@njit(cache=True, nogil=True)
def predicted_pose(prediction):
    """The predicted pose and twist. Rotation and translation that are not known follow from a constant twist."""
    b, h, d = prediction.before, prediction.step, _displacement(prediction)
    turn, position, rate, velocity = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):  # in loops: array expressions take seconds to compile
        turn[i], rate[i] = b.rate[i] * h, b.rate[i]
        position[i], velocity[i] = b.position[i] + d[i], d[i] / h
    R = prediction.rotation if prediction.knows_rotation else so3.exp(turn)
    return ScanPose(mul3(b.rotation, R), position, rate, velocity)


@njit(cache=True, nogil=True)
def _add_row(i, r, sigma, J_rate, H, g):
    """Adds a prediction of unknown i to the normal equations H (12, 12), g (12,). The residual r has the standard
    deviation sigma, the derivative 1 by unknown i, and -J_rate by the rate of it, unknown i + 6."""
    w, j = (POINT_SIGMA_M / sigma) ** 2, i + 6
    H[i, i] += w
    g[i] += w * r
    if J_rate != 0.0:
        H[i, j] -= w * J_rate
        H[j, i] -= w * J_rate
        H[j, j] += w * J_rate * J_rate
        g[j] -= w * J_rate * r


@njit(cache=True, nogil=True, inline="always")
def add_prediction(prediction, pose, H, g):
    """Adds the prediction of `pose` to the normal equations H (12, 12), g (12,), in units of POINT_SIGMA_M.

    Known rotations and translations are predicted directly. Unknown ones are predicted from the mean of the rates
    before and after; rates are predicted to be constant.
    """
    b, h, d = prediction.before, prediction.step, _displacement(prediction)
    R = mul3(b.rotation, prediction.rotation) if prediction.knows_rotation else b.rotation
    turn = so3.log(tmul3(R, pose.rotation))
    for i in range(3):
        if prediction.knows_rotation:
            _add_row(i, turn[i], GYRO_ROTATION_SIGMA, 0.0, H, g)
            _add_row(6 + i, pose.rate[i], GYRO_RATE_SIGMA, 0.0, H, g)
        else:
            _add_row(i, turn[i] - 0.5 * h * (b.rate[i] + pose.rate[i]), STEP_ROTATION_SIGMA, 0.5 * h, H, g)
            _add_row(6 + i, pose.rate[i] - b.rate[i], ANGULAR_ACCELERATION_SIGMA * h, 0.0, H, g)
        moved = pose.position[i] - b.position[i]
        if prediction.knows_translation:
            _add_row(3 + i, moved - d[i], KNOWN_TRANSLATION_SIGMA, 0.0, H, g)
            _add_row(9 + i, pose.velocity[i] - d[i] / h, ACCELERATION_SIGMA * h, 0.0, H, g)
        else:
            _add_row(3 + i, moved - 0.5 * h * (b.velocity[i] + pose.velocity[i]), STEP_POSITION_SIGMA, 0.5 * h, H, g)
            _add_row(9 + i, pose.velocity[i] - b.velocity[i], ACCELERATION_SIGMA * h, 0.0, H, g)


@njit(cache=True, nogil=True)
def register(voxels, xyz, tau, n_neighbour, prediction, final_scale):
    """Pose of a scan in the map (Gauss-Newton, point to plane), and its number of points near planes of the map.

    xyz (n, 3) [m] at tau (n,) [s] from the middle of the scan; steps that search neighbours use the first n_neighbour
    points only. The scale of the robust weights falls from FIRST_SCALE to final_scale, in edges of a voxel.
    """
    pose, near = predicted_pose(prediction), 0
    H, g = np.empty((N_SCAN_UNKNOWNS, N_SCAN_UNKNOWNS)), np.empty(N_SCAN_UNKNOWNS)
    for k in range(MAX_REGISTRATION_ROUNDS):
        share, wide = min(k / (NEIGHBOUR_ROUNDS + 1.0), 1.0), k < NEIGHBOUR_ROUNDS
        n = min(n_neighbour, len(xyz)) if wide else len(xyz)
        scale = voxels.edge_m * FIRST_SCALE ** (1.0 - share) * final_scale**share
        _, near = accumulate_scan(voxels, pose, xyz[:n], tau[:n], int(wide), scale, H, g)
        add_prediction(prediction, pose, H, g)
        if not solve_definite(H, g):
            break
        small = share == 1.0
        for i in range(N_SCAN_UNKNOWNS):
            g[i] = -g[i]
            small = small and (i >= 6 or abs(g[i]) < CONVERGED_STEP)
        pose = corrected_pose(pose, g)
        if small:
            break
    return pose, near
