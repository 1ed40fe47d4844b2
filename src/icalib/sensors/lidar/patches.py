"""Patches of surface that several LiDARs at rest see: which points of their clouds lie on which patch.

Surfaces are taken as flat within a cylinder along their normal. Wide patches are found first. Points that are left form
narrower ones, down to walls of furniture. Points are chosen by where their beams meet the plane, and by their distance
from it, not by cells of space: these would cut a wall along its noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

RADII_M = (2.0, 1.0, 0.5)  # of the patches: wider ones bend on roads, on narrower ones tilts are inaccurate
FEWEST_POINTS = 8  # of each of two LiDARs: a plane has three unknowns
GRAZING = 0.15  # least cosine between beam and normal, 81 deg: beams below meet the plane anywhere
FLAT_SHARE = 0.95  # of the points in the sphere must lie on the plane; at corners the rest tilts it
ROUGH_RATIO = 1.5  # largest scatter about the plane of a LiDAR's points, over the noise
SPREAD_SHARE = 0.2  # of the radius: least standard deviation of all points along the patch
LARGEST_TILT = 0.1  # slope between the planes of two LiDARs, which the pose explains in part


@dataclass(frozen=True)
class StopCloud:
    """Points of all LiDARs at one stop, in the frame of the body. points (N, 3), origins (N, 3) m: of the points and of
    the LiDARs that measured them; lidar (N,): index."""

    points: np.ndarray
    origins: np.ndarray
    lidar: np.ndarray


def shared_patches(cloud: StopCloud, noise_m: float, gate_m: float) -> np.ndarray:
    """(N,) int32: the patch of each point, numbered from 0; -1 for points on none. Points of a patch are nearer than
    gate_m to its plane, those of each LiDAR scatter about it as noise_m allows."""
    patch, count, tree = np.full(len(cloud.points), -1, np.int32), 0, KDTree(cloud.points)
    for radius_m in RADII_M:
        for near in tree.query_ball_point(_seeds(cloud, patch < 0, radius_m), radius_m):
            free = np.array(near, dtype=np.int64)
            free = free[patch[free] < 0]
            members = _members(cloud, free, noise_m, gate_m, radius_m)
            if len(members):
                patch[members], count = count, count + 1
    return patch


def _seeds(cloud: StopCloud, free: np.ndarray, radius_m: float) -> np.ndarray:
    """(s, 3) centroids of cells in which at least two LiDARs have points, those with most points first."""
    points = cloud.points[free]
    _, cell = np.unique(np.floor(points / radius_m).astype(np.int64), axis=0, return_inverse=True)
    n, lidars = int(cell.max(initial=-1)) + 1, int(cloud.lidar.max()) + 1
    count = np.bincount(cell.ravel() * lidars + cloud.lidar[free], minlength=n * lidars).reshape(n, lidars)
    second = np.sort(count, axis=1)[:, -2]
    centre = np.stack([np.bincount(cell.ravel(), points[:, k], n) for k in range(3)], axis=1)
    centre /= count.sum(axis=1, keepdims=True)
    order = np.argsort(-second, kind="stable")
    return centre[order[second[order] >= FEWEST_POINTS // 2]]


def _members(cloud: StopCloud, near: np.ndarray, noise_m: float, gate_m: float, radius_m: float) -> np.ndarray:
    """(m,) those of the points `near` that lie on one plane; none if they are not flat, or only one LiDAR sees it."""
    first = near[
        _on_plane(cloud, near, near, gate_m)[0]
    ]  # of the plane through all; then of that through those near it
    on, off, foot, side = _on_plane(cloud, first, near, gate_m)
    lidar = cloud.lidar[near[on]]
    if on.sum() < max(FLAT_SHARE * len(near), 1) or not _is_flat(lidar, off[on], foot[on], noise_m, radius_m):
        return near[:0]
    return near[on] if (side[on] == side[on][0]).all() else near[:0]


def _on_plane(
    cloud: StopCloud, through: np.ndarray, near: np.ndarray, gate_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of the points `near` (n,): whether each lies on the plane that fits those `through` best, and its LiDAR has
    enough points there; distances (n,) m; where their beams meet the plane (n, 3), from its centre; and the side (n,)
    from which they do. On none if fewer than two LiDARs measured points `through`."""
    if len(np.unique(cloud.lidar[through])) < 2:
        none = np.zeros(len(near))
        return none > 0.0, none, none, none
    normal, centre = _plane(cloud, through)
    beam = cloud.points[near] - cloud.origins[near]
    facing = beam @ normal
    off = (cloud.points[near] - centre) @ normal
    seen = np.abs(facing) > GRAZING * np.linalg.norm(beam, axis=1)
    foot = cloud.points[near] - (off / np.where(seen, facing, 1.0))[:, None] * beam - centre
    on = seen & (np.abs(off) < gate_m)
    count = np.bincount(cloud.lidar[near[on]], minlength=int(cloud.lidar.max()) + 1)
    return on & (count >= FEWEST_POINTS)[cloud.lidar[near]], off, foot, np.sign(facing)


def _plane(cloud: StopCloud, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal and centre of the plane through points, in which all LiDARs have the same weight."""
    lidar = cloud.lidar[members]
    weight = 1.0 / np.bincount(lidar)[lidar]
    points = cloud.points[members]
    centre = weight @ points / weight.sum()
    apart = points - centre
    return np.linalg.eigh((apart * weight[:, None]).T @ apart)[1][:, 0], centre


def _is_flat(lidar: np.ndarray, off: np.ndarray, foot: np.ndarray, noise_m: float, radius_m: float) -> bool:
    """Whether points of at least two LiDARs, at distances off (n,) m from a plane and at places foot (n, 3) m on it,
    are flat: each LiDAR's scatter about its own plane as noise does, and these planes are hardly inclined."""
    if np.linalg.svd(foot - foot.mean(axis=0), compute_uv=False)[1] < SPREAD_SHARE * radius_m * np.sqrt(len(foot)):
        return False
    axes = np.linalg.svd(foot, full_matrices=False)[2][:2]
    for k in np.unique(lidar):
        mine = lidar == k
        A = np.column_stack([np.ones(mine.sum()), foot[mine] @ axes.T])
        slope, *_ = np.linalg.lstsq(A, off[mine], rcond=0.05)
        scatter = np.sqrt(((off[mine] - A @ slope) ** 2).sum() / max(mine.sum() - 3, 1))
        if scatter > ROUGH_RATIO * noise_m or np.linalg.norm(slope[1:]) > LARGEST_TILT:
            return False
    return True
