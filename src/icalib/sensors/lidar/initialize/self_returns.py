"""Removal of self-returns: points of a LiDAR on the robot that carries it. They would form planes that move with it.

Self-returns occupy the same voxels in the frame of the LiDAR while it moves. Points on the floor below the robot, or
on the walls of a corridor, may do so as well. The LiDAR sees such places of the world also from a distance, before
it arrives or after it has left. It never sees a surface from a distance at the places where the robot was. The
trajectory for this comparison comes from odometry without the points in question."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import LidarStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.trajectories import SensorTrajectory
from icalib.sensors.lidar.initialize.odometry import MAX_MAPPED_POINTS, lidar_trajectory, sampled_scans

ROBOT_RADIUS_M = 2.5  # the robot is assumed not to extend further from its LiDAR
ROBOT_VOXEL_M = 0.1  # edge of the voxels in the frame of the LiDAR
N_VOXELS_SIDE = int(2 * ROBOT_RADIUS_M / ROBOT_VOXEL_M)
N_ROBOT_VOXELS = (N_VOXELS_SIDE + 2) ** 3  # including a margin of one voxel on each side
SCANS_PER_GROUP = 3  # enough for a point of most groups in each voxel of the robot
MAX_SEARCHED_SCANS = 600  # one minute at 10 Hz
MAX_GROUPS, MIN_GROUPS = 200, 10
MIN_OCCUPIED_SHARE = 0.8  # share of the groups with a point in a voxel of the robot
MIN_STEP_M, MIN_STEP_RAD = 0.2, 0.2  # motion of the LiDAR between groups; at rest all voxels seem occupied
WORLD_VOXEL_M = 0.2  # edge of the voxels in the world; twice ROBOT_VOXEL_M, as odometry errs by centimetres
MIN_SHARE_FROM_FAR = 0.5  # share of the world places of a voxel; a larger one means scene, not robot
MAX_FAR_POINTS = 1_000_000  # far points that are compared with these places; bounds the memory
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
    trajectory = _trajectory_without(stream, at)
    if trajectory is None:
        return None
    groups = _moving_groups(trajectory, _scan_of(trajectory, stream, near.first + SCANS_PER_GROUP // 2))
    if len(groups) < MIN_GROUPS:
        return None
    occupied = near.occupied(groups)
    return _dilated(occupied & ~_visible_from_far(stream, trajectory, near, groups, occupied))


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
        ijk = np.floor(stream.xyz[point] / np.float32(ROBOT_VOXEL_M)).astype(np.int64) + N_VOXELS_SIDE // 2 + 1
        voxel = (ijk[:, 0] * (N_VOXELS_SIDE + 2) + ijk[:, 1]) * (N_VOXELS_SIDE + 2) + ijk[:, 2]
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


def _visible_from_far(
    stream: LidarStream, trajectory: SensorTrajectory, near: _NearPoints, groups: np.ndarray, occupied: np.ndarray
) -> np.ndarray:
    """(N_ROBOT_VOXELS,) bool: most places of the world that an occupied voxel passed in `groups` (g,) are also seen by
    the LiDAR from beyond ROBOT_RADIUS_M."""
    near_points = np.isin(near.group, groups) & occupied[near.voxel]
    far = np.flatnonzero(np.einsum("na,na->n", stream.xyz, stream.xyz) > np.float32(ROBOT_RADIUS_M) ** 2)
    far = far[:: -(-len(far) // MAX_FAR_POINTS) | 1]
    voxel = near.voxel[near_points]
    visible = np.isin(
        _world_voxels(stream, trajectory, near.point[near_points]), _world_voxels(stream, trajectory, far)
    )
    n_places, n_visible = (np.bincount(voxel, weights=w, minlength=N_ROBOT_VOXELS) for w in (None, visible))
    return n_visible >= MIN_SHARE_FROM_FAR * np.maximum(n_places, 1)


def _world_voxels(stream: LidarStream, trajectory: SensorTrajectory, point: np.ndarray) -> np.ndarray:
    """(n,) world voxel of each point with index point (n,); -1 if the pose of its scan is not valid."""
    k = _scan_of(trajectory, stream, np.searchsorted(stream.start, point, side="right") - 1)
    world = np.einsum("nab,nb->na", trajectory.rotation[k], stream.xyz[point]) + trajectory.position[k]
    i, j, k3 = np.floor(world / WORLD_VOXEL_M).astype(np.int64).T
    return np.where(trajectory.ok[k], ((i << 42) + (j << 21) + k3), -1)


def _dilated(voxels: np.ndarray) -> np.ndarray:
    """Voxels (N_ROBOT_VOXELS,) with the 26 neighbours of each (binary dilation)."""
    grid = voxels.reshape(N_VOXELS_SIDE + 2, N_VOXELS_SIDE + 2, N_VOXELS_SIDE + 2)
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
