"""Points of a LiDAR that lie on its own robot: they would be planes that move along with it.

They keep their place in the LiDAR's frame while it moves. So do points of a floor that a robot drives on, or of a
corridor's walls; but those places of the world the LiDAR also sees from afar, before it comes or after it has gone,
while where the robot was there is nothing else to see. How the LiDAR moved its scans show, without these points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.data.measurements import LidarStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.trajectories.sensor_trajectory import SensorTrajectory
from icalib.sensors.lidar.initialize.odometry import MOST_MAPPED, lidar_path, scans_of

REACH_M = 2.5  # a robot does not reach further from its LiDAR
VOXEL_M = 0.1
SIDE = int(2 * REACH_M / VOXEL_M)
PLACES = (SIDE + 2) ** 3  # with a margin all round
SCANS_TOGETHER = 3  # so that each voxel of the robot has a point
MOST_SCANS = 600  # a minute at 10 Hz
MOST_GROUPS, FEWEST_GROUPS = 200, 10
STEADY = 0.8  # of the groups of scans have a point in a voxel of the robot
APART_M, APART_RAD = 0.2, 0.2  # between groups of scans that tell
WORLD_VOXEL_M = 0.2
SEEN_FROM_AFAR = 0.5  # of the places in the world where a voxel was: at least so many, and it is not the robot's
MOST_FAR = 1_000_000  # points
LEAST_SHARE = 1e-3  # of all points; fewer do no harm
ALL_ROUND = 0.3  # length of the mean direction


def without_own_robot(recording: Measurements) -> Measurements:
    """Without the points that LiDARs see of their own robot, and a warning for each LiDAR that does."""
    lidars, warnings = [], list(recording.warnings)
    for stream in recording.lidars:
        own = None if (stream.plane >= 0).any() else own_points(stream)
        if own is not None:
            warnings.append(_words(stream, own))
            stream = stream.some(~own)
        lidars.append(stream)
    return replace(recording.with_streams(*lidars), warnings=tuple(warnings))


def own_points(stream: LidarStream) -> np.ndarray | None:
    """(N,) bool: points on the LiDAR's own robot; None where there are none, or too few to do harm."""
    middle = _middle(stream)
    near = _Near.of(middle)
    robot = _robot(middle, near)
    if robot is None:
        return None
    whole, own = near if middle is stream else _Near.of(stream), np.zeros(len(stream.xyz), dtype=bool)
    own[whole.point[robot[whole.place]]] = True
    return own if np.count_nonzero(own) >= LEAST_SHARE * len(own) else None


def _middle(stream: LidarStream) -> LidarStream:
    """The scans in the middle of a recording, as many as it takes to tell."""
    if len(stream.stamps_ns) <= MOST_SCANS:
        return stream
    first = (len(stream.stamps_ns) - MOST_SCANS) // 2
    scans = slice(first, first + MOST_SCANS)
    start = stream.start[first : first + MOST_SCANS + 1]
    points = slice(int(start[0]), int(start[-1]))
    columns = (getattr(stream, name)[points] for name in ("offset_s", "xyz", "plane"))
    return LidarStream(stream.name, stream.stamps_ns[scans], start - start[0], *columns)


def _robot(stream: LidarStream, near: _Near) -> np.ndarray | None:
    """(PLACES,) bool: voxels of the robot; None where there are none, or nothing shows them."""
    steady = near.steady(np.arange(near.groups))
    at = near.point[steady[near.place]]
    if len(at) < LEAST_SHARE * len(stream.xyz):
        return None
    path = _path_without(stream, at)
    if path is None:
        return None
    apart = _apart(path, _scan_of(path, stream, near.first + SCANS_TOGETHER // 2))
    if len(apart) < FEWEST_GROUPS:
        return None
    steady = near.steady(apart)
    return _grown(steady & ~_seen_from_afar(stream, path, near, apart, steady))


@dataclass(frozen=True)
class _Near:
    """Points within reach: number of each (n,), increasing, and its voxel `place` (n,) in the LiDAR's frame. Scans are
    looked at in groups: `group` (n,) of each point, -1: none; first scan of each group."""

    point: np.ndarray
    place: np.ndarray
    group: np.ndarray
    first: np.ndarray

    @property
    def groups(self) -> int:
        return len(self.first)

    @classmethod
    def of(cls, stream: LidarStream) -> _Near:
        size2 = np.einsum("na,na->n", stream.xyz, stream.xyz)
        point = np.flatnonzero((size2 < np.float32(REACH_M) ** 2) & (size2 > 0.0))
        ijk = np.floor(stream.xyz[point] / np.float32(VOXEL_M)).astype(np.int64) + SIDE // 2 + 1
        place = (ijk[:, 0] * (SIDE + 2) + ijk[:, 1]) * (SIDE + 2) + ijk[:, 2]
        scans = len(stream.stamps_ns)
        step = max(SCANS_TOGETHER, scans // MOST_GROUPS)
        first = np.arange(0, scans - SCANS_TOGETHER + 1, step)
        scan = np.searchsorted(stream.start, point, side="right") - 1
        group = np.where((scan % step < SCANS_TOGETHER) & (scan // step < len(first)), scan // step, -1)
        return cls(point, place, group, first)

    def steady(self, groups: np.ndarray) -> np.ndarray:
        """(PLACES,) whether most of these groups have a point there."""
        number = np.full(self.groups + 1, -1)
        number[groups] = np.arange(len(groups))
        own = number[self.group]
        seen = np.zeros((PLACES, len(groups)), dtype=bool)
        seen[self.place[own >= 0], own[own >= 0]] = True
        return seen.sum(axis=1) >= max(STEADY * len(groups), 1.0)


def _path_without(stream: LidarStream, steady: np.ndarray) -> SensorTrajectory | None:
    """How the LiDAR moved, by its other points; None where they do not show it."""
    step = max(1, len(stream.xyz) // (MOST_MAPPED * len(stream.stamps_ns))) | 1
    kept = np.zeros(len(stream.xyz), dtype=bool)
    kept[::step] = True
    kept[steady] = False
    try:
        return lidar_path(stream.name, scans_of(stream.some(kept)))
    except EstimationError:
        return None


def _scan_of(path: SensorTrajectory, stream: LidarStream, scan: np.ndarray) -> np.ndarray:
    """(n,) which of the path's scans each of the stream's scans is, or is nearest to."""
    middle = stream.seconds[scan] + path.seconds[0] - stream.seconds[0]
    k = np.clip(np.searchsorted(path.seconds, middle), 1, len(path.seconds) - 1)
    return k - (middle - path.seconds[k - 1] < path.seconds[k] - middle)


def _apart(path: SensorTrajectory, at: np.ndarray) -> np.ndarray:
    """Those of the groups, which are at scans `at` (n,) of the path, between which the LiDAR moved."""
    chosen: list[int] = []
    for group, k in enumerate(at):
        if not path.ok[k]:
            continue
        if chosen:
            last = at[chosen[-1]]
            turn = np.linalg.norm(so3.log(np.ascontiguousarray(path.rotation[last].T @ path.rotation[k])))
            if turn < APART_RAD and np.linalg.norm(path.position[k] - path.position[last]) < APART_M:
                continue
        chosen.append(group)
    return np.array(chosen, dtype=np.int64)


def _seen_from_afar(
    stream: LidarStream, path: SensorTrajectory, near: _Near, groups: np.ndarray, steady: np.ndarray
) -> np.ndarray:
    """(PLACES,) whether most of the places of the world where a `steady` voxel was in these groups of scans are seen
    from afar at another time."""
    own = np.isin(near.group, groups) & steady[near.place]
    far = np.flatnonzero(np.einsum("na,na->n", stream.xyz, stream.xyz) > np.float32(REACH_M) ** 2)
    far = far[:: -(-len(far) // MOST_FAR) | 1]
    seen = np.isin(_in_world(stream, path, near.point[own]), _in_world(stream, path, far))
    times, of_them = (np.bincount(near.place[own], weights=w, minlength=PLACES) for w in (None, seen))
    return of_them >= SEEN_FROM_AFAR * np.maximum(times, 1)


def _in_world(stream: LidarStream, path: SensorTrajectory, point: np.ndarray) -> np.ndarray:
    """(n,) the voxel of the world that each point is in; -1: where the LiDAR was is not known."""
    k = _scan_of(path, stream, np.searchsorted(stream.start, point, side="right") - 1)
    world = np.einsum("nab,nb->na", path.rotation[k], stream.xyz[point]) + path.position[k]
    i, j, k3 = np.floor(world / WORLD_VOXEL_M).astype(np.int64).T
    return np.where(path.ok[k], ((i << 42) + (j << 21) + k3), -1)


def _grown(voxels: np.ndarray) -> np.ndarray:
    """With the 26 around each."""
    grid = voxels.reshape(SIDE + 2, SIDE + 2, SIDE + 2)
    for axis in range(3):
        grid = grid | np.roll(grid, 1, axis) | np.roll(grid, -1, axis)
    return grid.ravel()


def _words(stream: LidarStream, own: np.ndarray) -> str:
    xyz = stream.xyz[own].astype(np.float64)
    distance = np.linalg.norm(xyz, axis=1)
    low, high = np.percentile(distance, [1.0, 99.0])
    x, y, z = (xyz / distance[:, None]).mean(axis=0)
    azimuth, elevation = (round(np.rad2deg(a)) for a in (np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))))
    where = f"about azimuth {azimuth} deg, elevation {elevation} deg"
    if np.linalg.norm([x, y, z]) < ALL_ROUND:
        where = "on all sides"
    return (
        f"{stream.name} has self-returns: {own.mean():.1%} of its points move with its frame, {low:.2f} to "
        f"{high:.2f} m away, {where}. They were removed; to remove them by distance instead, set min_range of "
        f"{stream.name} to {high + 0.1:.1f} in the rig file, or mask them in its driver."
    )
