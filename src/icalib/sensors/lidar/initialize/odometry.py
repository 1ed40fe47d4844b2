"""How a LiDAR moved, scan by scan: each is registered to a map of flat voxels that those before it made.

A scan has a pose at its middle and a twist: each point is seen from where the LiDAR was at its own instant. Without the
gyroscope the twist holds for the turning, too; once the LiDAR is aligned with the IMU, the gyroscope turns the points
of a scan back to its middle, and says how it stands to the scan before.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.errors import EstimationError
from icalib.initialize.trajectories.sensor_trajectory import SensorTrajectory
from icalib.optim.arrowhead import THREADS
from icalib.sensors.lidar.initialize.registration import Expected, expected_pose, register
from icalib.sensors.lidar.initialize.voxel_map import ScanPose, VoxelMap, insert, pick, turn_back

MOST_MATCHED, MOST_MAPPED = 1500, 6000  # points of a scan
MOST_WIDE = 500  # while the pose is rough, and every point looks into many voxels
GOLDEN = 0.6180339887498949  # steps of this share of the whole leave no gaps, wherever they end
FEWEST_POINTS = 100
FEWEST_SCANS = 20
NEAREST_M = 0.3  # nearer than this is the LiDAR's own housing
VOXELS_IN_REACH = 8.0  # edges in the median range
EDGES_M = (0.3, 2.0)
CAPACITY = 1 << 17
LAST_SCALE, LAST_SCALE_TURNED = 0.2, 0.1
MOST_LOST = 5  # scans in a row that do not fit the map, before there is another
MANY = 200  # scans: worth two maps
SHARED, FEWEST_SHARED = 20, 5  # scans that are in both maps, where these are to be one
FEW = 10  # scans on a map that is no loss: its first scan may show too little of what the next ones see
MOST_ON_LINES = 0.8  # of a scan's points; where more lie on single rings, the scan has no surfaces
FEWEST_IN_VOXEL, NARROW = 5, 0.25  # points; width of a line, by its length
LEAST_NEAR = 0.3  # of a scan's points must lie on the map's planes
FIRST_ROUNDS = 4  # to find how the LiDAR moved in its first scan, which makes the map
KEEP, KEEP_TURNED = 0.85, 0.995  # of what a voxel holds, by the scan
TURN_STEP_S = 1e-3  # of the gyroscope's turns within a scan
LONGEST_STEP_S = 1.0

Turning = Callable[[np.ndarray], np.ndarray]  # instants (n,) on the LiDAR's clock -> R_start_lidar (n, 3, 3)
Moving = Callable[[np.ndarray], np.ndarray]  # -> p_start_lidar (n, 3) m, roughly


@dataclass(frozen=True)
class Scan:
    """middle [s]; points xyz (n, 3) and instants tau (n,) s from the middle, in an order that spreads them."""

    middle: float
    xyz: np.ndarray
    tau: np.ndarray


def scans_of(stream: LidarStream) -> list[Scan]:
    """Some points of each scan. Raises EstimationError where scans are too few."""
    with ThreadPoolExecutor(THREADS) as pool:
        scans = list(pool.map(lambda i: _scan_of(stream, i), range(len(stream.stamps_ns))))
    scans = [s for s in scans if len(s.tau) >= FEWEST_POINTS]
    if len(scans) < FEWEST_SCANS:
        raise EstimationError(
            f"{stream.name}: only {len(scans)} of its {len(stream.stamps_ns)} scans have {FEWEST_POINTS} points or "
            "more; check its topic, or record for longer."
        )
    return scans


def lidar_path(
    name: str, scans: list[Scan], turning: Turning | None = None, moving: Moving | None = None, whole: bool = True
) -> SensorTrajectory:
    """Scan-to-map odometry of LiDAR `name`. turning, moving: known rotation, translation.

    whole: one map for the whole recording, which begins later if hardly any scan fits the first. Else a lost path
    restarts in a new map, and scans within LONGEST_STEP_S after the last good one are not ok.

    Raises EstimationError if scans do not fit one another."""
    seconds = np.array([s.middle for s in scans])
    known = _Known.of(seconds, turning, moving)
    if turning is not None:
        scans = [_turned(s, turning) for s in scans]
    reach = float(np.median([np.median(np.linalg.norm(s.xyz, axis=1)) for s in scans]))
    edge_m = float(np.clip(reach / VOXELS_IN_REACH, *EDGES_M))
    poses, ok = (_follow_joined if whole else _follow_in_parts)(scans, known, edge_m)
    if ok.mean() < 0.5:
        why = "there may be too few flat surfaces, or the point times may be wrong"
        if (share := np.median([_share_on_lines(scan, edge_m) for scan in scans])) > MOST_ON_LINES:
            why = (
                f"{share:.0%} of the points of a scan lie on single rings, {edge_m:.1g} m and more apart, so "
                "that a scan shows no surfaces; record at the full resolution of the LiDAR, or use one with "
                "more rings"
            )
        raise EstimationError(
            f"{name}: only {ok.sum()} of {len(scans)} scans match the surfaces of other scans; {why}."
        )
    return SensorTrajectory(seconds, np.array([p.rotation for p in poses]), np.array([p.position for p in poses]), ok)


def _share_on_lines(scan: Scan, edge_m: float) -> float:
    """The share of the points in voxels with some of them whose points are one line: those of a single ring."""
    _, voxel, count = np.unique(np.floor(scan.xyz / edge_m), axis=0, return_inverse=True, return_counts=True)
    voxel = voxel.ravel()
    mean = np.stack([np.bincount(voxel, x) for x in scan.xyz.T], axis=1) / count[:, None]
    off = scan.xyz - mean[voxel]
    spread = np.array([[np.bincount(voxel, a * b) for a in off.T] for b in off.T]).transpose(2, 0, 1)
    size = np.sqrt(np.maximum(np.linalg.eigvalsh(spread), 0.0))
    used = count >= FEWEST_IN_VOXEL
    line = used & (size[:, 1] < NARROW * size[:, 2])
    return float(count[line].sum() / max(count[used].sum(), 1))


def _scan_of(stream: LidarStream, i: int) -> Scan:
    own = slice(int(stream.start[i]), int(stream.start[i + 1]))
    offset, xyz = stream.offset_s[own], stream.xyz[own]
    if not len(offset):
        return Scan(float(stream.seconds[i]), np.empty((0, 3)), np.empty(0))
    middle = 0.5 * (float(offset.min()) + float(offset.max()))
    chosen = spread(len(offset), MOST_MAPPED, i)
    for part in np.split(chosen, (MOST_WIDE, MOST_MATCHED)):
        part.sort()  # one after the other they mostly fall into the same voxels, which are at hand then
    points, tau = np.empty((len(chosen), 3)), np.empty(len(chosen))
    n = pick(xyz, offset, chosen, middle, NEAREST_M, points, tau)
    return Scan(float(stream.seconds[i]) + middle, points[:n], tau[:n])


def spread(n: int, most: int, begin: int) -> np.ndarray:
    """(min(n, most),) different indices below n, of which the first few, too, are spread over all."""
    step = max(int(GOLDEN * n), 1)
    while np.gcd(step, n) > 1:
        step += 1
    return (begin + np.arange(min(n, most)) * step) % n


def _turned(scan: Scan, turning: Turning) -> Scan:
    """The scan as seen by a LiDAR that stands as in its middle."""
    which = np.floor(scan.tau / TURN_STEP_S).astype(np.int64)
    low = which.min()
    steps = scan.middle + (np.arange(low, which.max() + 1) + 0.5) * TURN_STEP_S
    R = turning(np.append(steps, scan.middle))
    xyz = scan.xyz.copy()
    turn_back(xyz, which - low, np.ascontiguousarray(R[-1].T @ R[:-1]))
    return Scan(scan.middle, xyz, scan.tau)


@dataclass(frozen=True)
class _Known:
    """Of each scan (n,) but the first, as far as it is known: R_before_scan (3, 3), and p_before_scan (3,)."""

    turned: np.ndarray | None
    way: np.ndarray | None

    @classmethod
    def of(cls, seconds: np.ndarray, turning: Turning | None, moving: Moving | None) -> _Known:
        if turning is None:
            return cls(None, None)
        R = turning(seconds)
        back = np.concatenate([R[:1], R[:-1]]).transpose(0, 2, 1)
        way = None if moving is None else np.diff(p := moving(seconds), axis=0, prepend=p[:1])
        return cls(back @ R, None if way is None else np.einsum("nij,nj->ni", back, way))

    def some(self, own: slice) -> _Known:
        """Of some of the scans."""
        return _Known(*(None if x is None else x[own] for x in (self.turned, self.way)))


def _follow_in_parts(scans: list[Scan], known: _Known, edge_m: float) -> tuple[list[ScanPose], np.ndarray]:
    """As `_follow`, in several maps: a long path is two, each on a thread."""
    n, seconds = len(scans), np.array([s.middle for s in scans])
    parts = [slice(0, n)] if n < MANY else [slice(0, n // 2), slice(n // 2, n)]
    found = _follow_at_once(scans, known, edge_m, parts, False)
    ok = np.concatenate([fits for _, fits in found])
    for own in parts[1:]:
        ok[own] &= seconds[own] > seconds[own.start - 1] + LONGEST_STEP_S
    return [pose for poses, _ in found for pose in poses], ok


def _follow_joined(scans: list[Scan], known: _Known, edge_m: float) -> tuple[list[ScanPose], np.ndarray]:
    """As `_follow`, in one map: of a long path two that share some scans are made at once, and joined by these."""
    middle = len(scans) // 2
    if len(scans) >= MANY:
        parts = [slice(0, middle + SHARED), slice(middle, len(scans))]
        (before, fits), (after, fit_after) = _follow_at_once(scans, known, edge_m, parts, True)
        both = np.flatnonzero(fits[middle:] & fit_after[:SHARED])
        if len(both) >= FEWEST_SHARED:
            joined = _in_map_of([before[middle + k] for k in both], [after[k] for k in both], after[SHARED:])
            return [*before, *joined], np.concatenate([fits, fit_after[SHARED:]])
    return _follow(scans, known, edge_m, True)


def _follow_at_once(
    scans: list[Scan], known: _Known, edge_m: float, parts: list[slice], whole: bool
) -> list[tuple[list[ScanPose], np.ndarray]]:
    """`_follow` of each of the parts, on a thread of its own."""
    with ThreadPoolExecutor(len(parts)) as pool:
        return list(pool.map(lambda own: _follow(scans[own], known.some(own), edge_m, whole), parts))


def _in_map_of(here: list[ScanPose], there: list[ScanPose], others: list[ScanPose]) -> list[ScanPose]:
    """The poses `others` of the map of `there` in that of `here`, which are of the same scans."""
    u, _, vt = np.linalg.svd(
        sum((a.rotation @ b.rotation.T for a, b in zip(here, there, strict=True)), np.zeros((3, 3)))
    )
    R = u @ vt  # the mean: all are near one another
    p = np.mean([a.position - R @ b.position for a, b in zip(here, there, strict=True)], axis=0)
    return [ScanPose(R @ x.rotation, p + R @ x.position, x.rate, R @ x.velocity) for x in others]


def _follow(scans: list[Scan], known: _Known, edge_m: float, whole: bool) -> tuple[list[ScanPose], np.ndarray]:
    """Poses, and whether each fits its map; see `lidar_path`."""
    fits = np.ones(len(scans), dtype=bool)

    def place(k: int, before: ScanPose, scale: float) -> ScanPose:
        step = scans[k].middle - scans[k - 1].middle
        turned, way = (None if x is None else x[k] for x in (known.turned, known.way))
        expected = Expected.of(before, min(step, LONGEST_STEP_S), turned, way)
        pose, fits[k] = _register(voxels, scans[k], expected, scale)
        return pose

    def begin(k: int) -> ScanPose:
        """Starts a new map from scan k, with rate and velocity estimated by registering scan k + 1."""
        pose = still
        for _ in range(FIRST_ROUNDS):
            voxels.clear()
            insert(voxels, pose, scans[k].xyz, scans[k].tau, k, 1.0)
            after = place(k + 1, pose, LAST_SCALE)
            pose = still._replace(rate=after.rate, velocity=after.velocity)
        return pose

    last, keep = (LAST_SCALE, KEEP) if known.turned is None else (LAST_SCALE_TURNED, KEEP_TURNED)
    still = ScanPose(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    voxels = VoxelMap.empty(edge_m, CAPACITY)
    poses, lost = [begin(0)], 0
    apart, again = np.zeros(len(scans), dtype=bool), -np.inf
    for k in range(1, len(scans)):
        pose = place(k, poses[-1], last)
        lost = 0 if fits[k] else lost + 1
        if lost == MOST_LOST and k + 1 < len(scans) and not (whole and np.count_nonzero((fits & ~apart)[:k]) > FEW):
            if whole:
                apart[:k] = True
            else:
                again = scans[k - lost].middle + LONGEST_STEP_S
            pose, lost = begin(k), 0
        apart[k] = scans[k].middle < again
        poses.append(pose)
        if fits[k]:
            insert(voxels, pose, scans[k].xyz, scans[k].tau, k, keep)
    return poses, fits & ~apart


def _register(voxels: VoxelMap, scan: Scan, expected: Expected, last: float) -> tuple[ScanPose, bool]:
    """The scan's pose, and whether it fits the map."""
    xyz, tau = scan.xyz[:MOST_MATCHED], scan.tau[:MOST_MATCHED]
    pose, near = register(voxels, xyz, tau, MOST_WIDE, expected, last)
    return (pose, True) if near > LEAST_NEAR * len(tau) else (expected_pose(expected), False)
