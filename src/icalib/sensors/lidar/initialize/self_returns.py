"""Removal of self-returns: points of a LiDAR on the robot that carries it. They would form planes that move with it.

Self-returns occupy the same voxels in the frame of the LiDAR while it moves. Points on the floor below the robot, on
the walls of a corridor, or on a board in front of the LiDAR may do so as well. Beams tell them apart: once the robot
has moved on, they pass through the places where it was, and never through a surface of the scene (visibility, as in
the removal of moving objects from maps). The trajectory for this comparison comes from odometry without the points in
question.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation, Slerp

from icalib.base.remark import Remark
from icalib.data.measurements import LidarStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.trajectories import SensorTrajectory
from icalib.sensors.lidar.initialize.odometry import (
    MAX_MAPPED_POINTS,
    MAX_MATCHED_POINTS,
    POINT_SIGMA_M,
    STEP_POSITION_SIGMA,
    lidar_trajectory,
    sampled_scans,
)
from icalib.sensors.lidar.initialize.registration import Surfels

ROBOT_RADIUS_M = 2.5  # the robot is assumed not to extend further from its LiDAR
ROBOT_VOXEL_M = 0.1  # edge of the voxels in the frame of the LiDAR
N_VOXELS_SIDE = int(2 * ROBOT_RADIUS_M / ROBOT_VOXEL_M)
GRID = (N_VOXELS_SIDE + 2,) * 3  # including a margin of one voxel on each side
N_ROBOT_VOXELS = GRID[0] ** 3
SCANS_PER_GROUP = 3  # enough for a point of most groups in each voxel of the robot
MAX_SEARCHED_SCANS = 600  # one minute at 10 Hz
MAX_GROUPS, MIN_GROUPS = 200, 10
MIN_OCCUPIED_SHARE = 0.8  # share of the groups with a point in a voxel of the robot
MIN_STEP_M, MIN_STEP_RAD = 0.2, 0.2  # motion of the LiDAR between groups; at rest all voxels seem occupied
N_SURFEL_SCANS = 9  # spread over the recording, whose surfaces must fix the position
MAX_VIEWS = 30  # groups whose beams are compared with the places of all; bounds the time
MAX_VIEWED_POINTS = 1_000_000  # of all views
CELL_RAD = ROBOT_VOXEL_M / ROBOT_RADIUS_M  # edge of the cells of a view: a voxel at the largest distance
MIN_SHARE_THROUGH = 0.3  # of the beams at places of the robot; floor, walls and boards have up to 0.16
MARGIN_M = 2.0 * ROBOT_VOXEL_M  # between a place and a surface that is not there, as odometry errs by centimetres
MIN_SELF_RETURN_SHARE = 1e-3  # of all points; fewer are rejected by the robust loss
MAX_MEAN_DIRECTION = 0.3  # length of the mean of unit directions; directions with a shorter mean are "on all sides"


def without_self_returns(recording: Measurements) -> Measurements:
    """The recording without self-returns, and a warning for each LiDAR that has some. A LiDAR whose points have known
    planes is left as it is."""
    lidars, warnings = [], list(recording.warnings)
    for stream in recording.lidars:
        self_returns = None if (stream.plane >= 0).any() else self_returns_of(stream)
        if self_returns is not None:
            warnings.append(_warning(stream, self_returns))
            stream = stream.some(~self_returns)
        lidars.append(stream)
    return replace(recording.with_streams(*lidars), warnings=tuple(warnings))


def self_returns_of(stream: LidarStream) -> np.ndarray | None:
    """(N,) bool: the point is a self-return; None if there are none, or too few to do harm."""
    middle = _middle_scans(stream)
    near = _NearPoints.of(middle)
    robot = _robot_voxels(middle, near)
    if robot is None:
        return None
    all_near, self_returns = near if middle is stream else _NearPoints.of(stream), np.zeros(len(stream.xyz), dtype=bool)
    self_returns[all_near.point[robot[all_near.voxel]]] = True
    return self_returns if np.count_nonzero(self_returns) >= MIN_SELF_RETURN_SHARE * len(self_returns) else None


def _middle_scans(stream: LidarStream) -> LidarStream:
    """At most MAX_SEARCHED_SCANS scans from the middle of a recording."""
    if len(stream.stamps_ns) <= MAX_SEARCHED_SCANS:
        return stream
    first = (len(stream.stamps_ns) - MAX_SEARCHED_SCANS) // 2
    scans = slice(first, first + MAX_SEARCHED_SCANS)
    start = stream.start[first : first + MAX_SEARCHED_SCANS + 1]
    points = slice(int(start[0]), int(start[-1]))
    columns = (getattr(stream, name)[points] for name in ("offset_s", "xyz", "plane"))
    return LidarStream(stream.name, stream.stamps_ns[scans], start - start[0], *columns)


def _robot_voxels(stream: LidarStream, near: _NearPoints) -> np.ndarray | None:
    """(N_ROBOT_VOXELS,) bool: the voxel belongs to the robot; None if none does, or if the LiDAR moved too little."""
    occupied = near.occupied(np.arange(near.groups))
    at = near.point[occupied[near.voxel]]
    if len(at) < MIN_SELF_RETURN_SHARE * len(stream.xyz):
        return None
    trajectory = _trajectory_without(stream, at) if _fixes_position(stream, near, at) else None
    if trajectory is None:
        return None
    groups = _moving_groups(trajectory, _scan_of(trajectory, stream, near.first + SCANS_PER_GROUP // 2))
    if len(groups) < MIN_GROUPS:
        return None
    occupied = near.occupied(groups)
    return _dilated(_seen_through(_BeamViews.of(stream, trajectory.only(trajectory.ok), near, groups), occupied))


@dataclass(frozen=True)
class _NearPoints:
    """Points within ROBOT_RADIUS_M of the LiDAR. point (n,): index of each in the stream, increasing; voxel (n,): its
    voxel in the frame of the LiDAR; group (n,): its group of scans, -1: none; first (G,): first scan of each group."""

    point: np.ndarray
    voxel: np.ndarray
    group: np.ndarray
    first: np.ndarray

    @property
    def groups(self) -> int:
        """Number of groups."""
        return len(self.first)

    @classmethod
    def of(cls, stream: LidarStream) -> _NearPoints:
        """Near points of all scans of a stream."""
        size2 = np.einsum("na,na->n", stream.xyz, stream.xyz)
        point = np.flatnonzero((size2 < np.float32(ROBOT_RADIUS_M) ** 2) & (size2 > 0.0))
        voxel = _voxel(stream.xyz[point])
        scans = len(stream.stamps_ns)
        step = max(SCANS_PER_GROUP, scans // MAX_GROUPS)
        first = np.arange(0, scans - SCANS_PER_GROUP + 1, step)
        scan = np.searchsorted(stream.start, point, side="right") - 1
        group = np.where((scan % step < SCANS_PER_GROUP) & (scan // step < len(first)), scan // step, -1)
        return cls(point, voxel, group, first)

    def occupied(self, groups: np.ndarray) -> np.ndarray:
        """(N_ROBOT_VOXELS,) bool: most of `groups` (g,) have a point in the voxel."""
        number = np.full(self.groups + 1, -1)
        number[groups] = np.arange(len(groups))
        column = number[self.group]
        occupied = np.zeros((N_ROBOT_VOXELS, len(groups)), dtype=bool)
        occupied[self.voxel[column >= 0], column[column >= 0]] = True
        return occupied.sum(axis=1) >= max(MIN_OCCUPIED_SHARE * len(groups), 1.0)


def _voxel(xyz: np.ndarray) -> np.ndarray:
    """(n,) voxels of points xyz (n, 3) m in the frame of the LiDAR; those of the margin for points farther away."""
    ijk = np.floor(xyz / np.float32(ROBOT_VOXEL_M)).astype(np.int64) + N_VOXELS_SIDE // 2 + 1
    return np.clip(ijk, 0, GRID[0] - 1) @ np.array([GRID[0] ** 2, GRID[0], 1])


def _fixes_position(stream: LidarStream, near: _NearPoints, excluded: np.ndarray) -> bool:
    """The surfaces of scans without the points `excluded` (n,) face enough directions for odometry: along each, their
    points say more of a step than its prediction does. Otherwise the trajectory slides (as in Zhang et al., 2016)."""
    kept, shares = np.ones(len(stream.xyz), dtype=bool), []
    kept[excluded] = False
    for k in near.first[np.linspace(0, near.groups - 1, N_SURFEL_SCANS).astype(int)]:
        rows = slice(int(stream.start[k]), int(stream.start[k + 1]))
        normal = Surfels.of(stream.xyz[rows][kept[rows]]).normal
        shares.append(np.linalg.eigvalsh(normal.T @ normal)[0] / max(len(normal), 1))
    return bool(np.median(shares) * MAX_MATCHED_POINTS > (POINT_SIGMA_M / STEP_POSITION_SIGMA) ** 2)


def _trajectory_without(stream: LidarStream, excluded: np.ndarray) -> SensorTrajectory | None:
    """Trajectory from odometry without the points `excluded` (n,); None if odometry fails."""
    step = max(1, len(stream.xyz) // (MAX_MAPPED_POINTS * len(stream.stamps_ns))) | 1
    kept = np.zeros(len(stream.xyz), dtype=bool)
    kept[::step] = True
    kept[excluded] = False
    try:
        return lidar_trajectory(stream.name, sampled_scans(stream.some(kept)))
    except EstimationError:
        return None


def _scan_of(trajectory: SensorTrajectory, stream: LidarStream, scan: np.ndarray) -> np.ndarray:
    """(n,) scans of the trajectory that are nearest to the scans (n,) of the stream."""
    middle = stream.seconds[scan] + trajectory.seconds[0] - stream.seconds[0]
    k = np.clip(np.searchsorted(trajectory.seconds, middle), 1, len(trajectory.seconds) - 1)
    return k - (middle - trajectory.seconds[k - 1] < trajectory.seconds[k] - middle)


def _moving_groups(trajectory: SensorTrajectory, at: np.ndarray) -> np.ndarray:
    """Groups (g,) between which the LiDAR moved; at (n,): scan of the trajectory for each group."""
    chosen: list[int] = []
    for group, k in enumerate(at):
        if not trajectory.ok[k]:
            continue
        if chosen:
            last = at[chosen[-1]]
            turn = np.linalg.norm(so3.log(np.ascontiguousarray(trajectory.rotation[last].T @ trajectory.rotation[k])))
            if turn < MIN_STEP_RAD and np.linalg.norm(trajectory.position[k] - trajectory.position[last]) < MIN_STEP_M:
                continue
        chosen.append(group)
    return np.array(chosen, dtype=np.int64)


@dataclass(frozen=True)
class _BeamViews:
    """Beams and near places of some groups of scans. pose: of the LiDAR at the groups (V,); beams: for each, points of
    its middle scan in the frame of that pose (n, 3) m; place (m, 3) m: points in the map, one in each voxel and group,
    and their voxel (m,)."""

    pose: SensorTrajectory
    beams: list[np.ndarray]
    place: np.ndarray
    voxel: np.ndarray

    @classmethod
    def of(cls, stream: LidarStream, path: SensorTrajectory, near: _NearPoints, groups: np.ndarray) -> _BeamViews:
        """At most MAX_VIEWS of `groups` (g,), on the known path of the LiDAR."""
        groups = groups[np.unique(np.linspace(0, len(groups) - 1, MAX_VIEWS).astype(int))]
        scan = near.first[groups] + SCANS_PER_GROUP // 2
        pose = path.only(_scan_of(path, stream, scan))
        beams = []
        for i, k in enumerate(scan):
            rows = np.arange(int(stream.start[k]), int(stream.start[k + 1]))
            rows = rows[:: -(-len(rows) * len(scan) // MAX_VIEWED_POINTS) | 1]
            beams.append((_in_map(stream, path, rows) - pose.position[i]) @ pose.rotation[i])
        some = np.flatnonzero(np.isin(near.group, groups))
        _, first = np.unique(near.group[some] * N_ROBOT_VOXELS + near.voxel[some], return_index=True)
        return cls(pose, beams, _in_map(stream, path, near.point[some[first]]), near.voxel[some[first]])


def _in_map(stream: LidarStream, path: SensorTrajectory, point: np.ndarray) -> np.ndarray:
    """(n, 3) m in the map: points with index point (n,), by the pose at the instant of each."""
    scan = np.searchsorted(stream.start, point, side="right") - 1
    t = np.clip(stream.seconds[scan] + stream.offset_s[point], path.seconds[0], path.seconds[-1])
    position = np.stack([np.interp(t, path.seconds, p) for p in path.position.T], axis=1)
    return position + Slerp(path.seconds, Rotation.from_matrix(path.rotation))(t).apply(stream.xyz[point])


def _seen_through(views: _BeamViews, occupied: np.ndarray) -> np.ndarray:
    """(N_ROBOT_VOXELS,) bool: the voxel is occupied, and beams pass through the places where it was."""
    through, ends, covered = np.zeros(N_ROBOT_VOXELS), np.zeros(N_ROBOT_VOXELS), _dilated(occupied)
    some = occupied[views.voxel]
    place, voxel = views.place[some], views.voxel[some]
    for R, p, beams in zip(views.pose.rotation, views.pose.position, views.beams, strict=True):
        xyz = (place - p) @ R
        size = np.linalg.norm(xyz, axis=1)
        nearest, farthest = (limit[_cell(xyz)] for limit in _limits(beams[~covered[_voxel(beams)]]))
        elsewhere = ~covered[_voxel(xyz)] & np.isfinite(nearest)  # of the robot nothing is there now
        passes, ends_there = nearest > size + MARGIN_M, np.abs(np.clip(size, nearest, farthest) - size) <= MARGIN_M
        through += np.bincount(voxel, elsewhere & passes, N_ROBOT_VOXELS)
        ends += np.bincount(voxel, elsewhere & ends_there, N_ROBOT_VOXELS)
    return through > MIN_SHARE_THROUGH * (through + ends)


def _cell(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells of a view, by elevation and azimuth, in the directions xyz (n, 3)."""
    azimuth, elevation = np.arctan2(xyz[:, 1], xyz[:, 0]), np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    return ((elevation + 0.5 * np.pi) / CELL_RAD).astype(int), ((azimuth + np.pi) / CELL_RAD).astype(int)


def _limits(beams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shortest and longest range [m] of the beams (n, 3) in each cell and its neighbours; infinite where none is."""
    size, cell = np.linalg.norm(beams, axis=1), _cell(beams)
    cells = int(np.pi / CELL_RAD) + 1, int(2.0 * np.pi / CELL_RAD) + 1
    nearest, farthest = np.full(cells, np.inf), np.zeros(cells)
    np.minimum.at(nearest, cell, size)
    np.maximum.at(farthest, cell, size)
    return minimum_filter(nearest, 3, mode="wrap"), maximum_filter(farthest, 3, mode="wrap")


def _dilated(voxels: np.ndarray) -> np.ndarray:
    """Voxels (N_ROBOT_VOXELS,) with the 26 neighbours of each (binary dilation)."""
    grid = voxels.reshape(GRID)
    for axis in range(3):
        grid = grid | np.roll(grid, 1, axis) | np.roll(grid, -1, axis)
    return grid.ravel()


def _warning(stream: LidarStream, self_returns: np.ndarray) -> Remark:
    """The warning on self-returns `self_returns` (N,) bool: their share, distance and direction."""
    xyz = stream.xyz[self_returns].astype(np.float64)
    distance = np.linalg.norm(xyz, axis=1)
    low, high = np.percentile(distance, [1.0, 99.0])
    x, y, z = (xyz / distance[:, None]).mean(axis=0)
    azimuth, elevation = (round(np.rad2deg(a)) for a in (np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))))
    where = f"about azimuth {azimuth} deg, elevation {elevation} deg"
    if np.linalg.norm([x, y, z]) < MAX_MEAN_DIRECTION:
        where = "on all sides"
    return Remark(
        "self_returns_removed",
        f"{stream.name} has self-returns: {self_returns.mean():.1%} of its points move with its frame, {low:.2f} to "
        f"{high:.2f} m away, {where}. They were removed; to remove them by distance instead, set min_range of "
        f"{stream.name} to {high + 0.1:.1f} in the rig file, or mask them in its driver.",
    )
