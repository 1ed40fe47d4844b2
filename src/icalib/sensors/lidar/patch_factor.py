"""The factor of patches of surface that several LiDARs at rest see.

    off(x) = n . (R_l x + p_l - c) = (1, s, t) . theta + noise    for each point x of LiDAR l on the patch

Here n and c are a normal and a centre of the patch, and (s, t) is the place at which the beam meets it, all constant
within a pass. R_l, p_l is the pose of LiDAR l in the body, which is one of the LiDARs. The plane theta, an offset and
two slopes, is the same for all LiDARs and unknown. It is eliminated: of whitened sums z_l = W_l sum (1, s, t) off(x),
the combinations remain that do not depend on theta. They are the rows of the factor. No pose of the body enters.

Places come from beams and not from points: range noise moves points of oblique beams along the surface and across it at
once, which would tilt the plane.

Surfaces are taken as flat within a cylinder along their normal. Wide patches are found first. Points that are left form
narrower ones, down to walls of furniture. Points are chosen by where their beams meet the plane, and by their distance
from it, not by cells of space: these would cut a wall along its noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from scipy.spatial import KDTree

from icalib.data.measurements import LidarStream
from icalib.geometry.planes import tangents
from icalib.model.sensor_model import Pass
from icalib.motion.factor import (
    FactorKey,
    Into,
    RobustNoise,
    RowFactor,
    Whitened,
    add_rows,
    chi2,
    output_at,
    rows_by_recording,
)
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import MERGED_WITHIN_S, instants, pose_columns
from icalib.optim.arrowhead import Piece
from icalib.optim.rows import KEYFRAME_PAIR_DIM, Rows
from icalib.optim.state import Layout, State
from icalib.sensors.lidar.binning import LidarNoise
from icalib.sensors.lidar.residual import true_points

ON_PATCHES = "points on shared surfaces"  # kind of residuals
GATE_SIGMAS = 4.0  # largest distance of a used point from its patch, in standard deviations of the noise
USUAL_WEIGHT = 10.0  # points: weight of the usual variance in that of a patch, whose few points estimate it badly
FLATNESS_M, FLATNESS_STEP = (1e-4, 0.2), 1.05  # range of flatness, and relative accuracy
MIN_SIGMA_M = 1e-3  # of points: keeps weights of simulated points without noise finite
LEAST_SPREAD = 1e-6  # of moments, relative to the largest: directions along a patch in which a LiDAR has no extent


@dataclass(frozen=True)
class PatchPoints:
    """Points of several LiDARs on P patches. patch (n,): sorted, 0 to P - 1; lidar (n,): index; xyz (n, 3) m: in the
    frame of the LiDAR; keyframe (P,), increasing: of each patch."""

    patch: np.ndarray
    lidar: np.ndarray
    xyz: np.ndarray
    keyframe: np.ndarray

    @classmethod
    def of(cls, streams: Mapping[str, LidarStream], state: State, noise_m: float, gate_m: float) -> PatchPoints:
        """The points on patches that at least two LiDARs see at the poses of `state`; noise_m, gate_m: see
        `shared_patches`."""
        names, P = tuple(streams), 0
        patch, lidar, xyz, keyframe = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros((0, 3))], [np.zeros(0, int)]
        scans = [_scan_at_keyframes(stream, state) for stream in streams.values()]
        for k in range(len(state.seconds)):
            clouds = [_cloud(stream, scan[k]) for stream, scan in zip(streams.values(), scans, strict=True)]
            if not any(map(len, clouds)):  # the second keyframe of a single stop
                continue
            of_lidar = np.repeat(np.arange(len(names)), [len(cloud) for cloud in clouds])
            points = cls(of_lidar, of_lidar, np.concatenate(clouds), np.full(1, k))
            number = shared_patches(StopCloud(*points.in_body(names, state), of_lidar), noise_m, gate_m)
            order = np.argsort(number, kind="stable")[int((number < 0).sum()) :]
            patch.append(number[order] + P)
            lidar.append(of_lidar[order])
            xyz.append(points.xyz[order])
            keyframe.append(np.full(int(number.max(initial=-1)) + 1, k))
            P += len(keyframe[-1])
        return cls(*(np.concatenate(x) for x in (patch, lidar, xyz, keyframe)))

    def in_body(self, names: tuple[str, ...], state: State) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) and positions (n, 3) of their LiDARs in the frame of the body [m]."""
        R = np.array([state.values[name, "rotation"] for name in names])[self.lidar]
        p = np.array([state.values[name, "translation"] for name in names])[self.lidar]
        return np.einsum("nij,nj->ni", R, self.xyz) + p, p

    def planes(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normals and centres (P, 3) of the planes that fit points (n, 3) best."""
        P, n = len(self.keyframe), np.bincount(self.patch, minlength=len(self.keyframe)).astype(float)
        centre = _sums(self.patch, P, points) / n[:, None]
        apart = points - centre[self.patch]
        spread = _sums(self.patch, P, (apart[:, :, None] * apart[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
        return np.linalg.eigh(spread)[1][:, :, 0], centre


def _scan_at_keyframes(stream: LidarStream, state: State) -> np.ndarray:
    """(K,) number of the scan at each keyframe, -1 if there is none."""
    times = instants(stream, state.values)
    nearest = np.argmin(np.abs(times - state.seconds[:, None]), axis=1)
    return np.where(np.abs(times[nearest] - state.seconds) <= MERGED_WITHIN_S, nearest, -1)


def _cloud(stream: LidarStream, scan: int) -> np.ndarray:
    """Points (n, 3) of a scan; none for -1."""
    return stream.xyz[stream.start[scan] : stream.start[scan + 1]].astype(float) if scan >= 0 else np.zeros((0, 3))


def _sums(index: np.ndarray, n: int, values: np.ndarray) -> np.ndarray:
    """(n, k) sums of values (m, k) with the same index (m,)."""
    return np.stack([np.bincount(index, column, n) for column in values.T], axis=1)


@dataclass(frozen=True)
class PatchRows:
    """Rows without unknown planes, from the points at a state. A row is the sum over the LiDARs l of

        offset[l] n . (p_l - c) + normal[l] . (R_l^T n)

    offset (n, L), normal (n, L, 3); n, c (n, 3): normal and centre of the patch; keyframe (n,). point_sigma [m]: of
    points about the planes of their LiDAR."""

    offset: np.ndarray
    normal: np.ndarray
    n: np.ndarray
    c: np.ndarray
    keyframe: np.ndarray
    point_sigma: float

    @classmethod
    def of(cls, points: PatchPoints, names: tuple[str, ...], state: State, sigma: float, flatness: float) -> PatchRows:
        """The rows at `state`. sigma, flatness [m]: standard deviations of a point, if no patch shows it, and of the
        planes that LiDARs see from the plane of the patch."""
        P, L = len(points.keyframe), len(names)
        body, origin = points.in_body(names, state)
        normal, centre = points.planes(body)
        n, beam, x = normal[points.patch], body - origin, body - centre[points.patch]
        off = (x * n).sum(axis=1)
        foot = x - (off / (beam * n).sum(axis=1))[:, None] * beam
        axes = np.array([tangents(v) for v in normal])[points.patch]
        A = np.concatenate([np.ones((len(x), 1)), np.einsum("nij,nj->ni", axes, foot)], axis=1)
        cell = points.patch * L + points.lidar
        of_lidar = np.concatenate([np.ones((len(x), 1)), points.xyz], axis=1)
        moments = _sums(cell, P * L, (A[:, :, None] * of_lidar[:, None, :]).reshape(-1, 12)).reshape(-1, 3, 4)
        inner = _sums(cell, P * L, (A[:, :, None] * A[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
        root, whitening = _roots(inner)
        along = np.einsum("cij,cj->ci", whitening, _sums(cell, P * L, A * off[:, None]))
        squares = _sums(cell, P * L, off[:, None] ** 2)[:, 0] - (along**2).sum(axis=1)
        dof = np.maximum(inner[:, 0, 0] - 3.0, 0.0)
        squares = np.maximum(squares, MIN_SIGMA_M**2 * dof)
        usual = squares.sum() / dof.sum() if dof.any() else sigma**2
        variance = (squares + USUAL_WEIGHT * usual) / (dof + USUAL_WEIGHT)
        scale = 1.0 / np.sqrt(variance)[:, None, None]
        S, M = scale * root, scale * (whitening @ moments)
        W = _whitening(S, inner, flatness, L)
        S, M = (W @ S).reshape(P, 3 * L, 3), (W @ M).reshape(P, L, 3, 4)
        patch, combination = _free_of_planes(S)
        rows = np.einsum("rlk,rlka->rla", combination.reshape(-1, L, 3), M[patch])
        n, c, keyframe = normal[patch], centre[patch], points.keyframe[patch]
        return cls(rows[:, :, 0], rows[:, :, 1:], n, c, keyframe, float(np.sqrt(usual)))

    def at(self, names: tuple[str, ...], state: State) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (n,), and their Jacobians (n, L, 6) by rotation (on the right) and translation of each LiDAR."""
        residual, J = np.zeros(len(self.n)), np.zeros((*self.offset.shape, 6))
        for k, name in enumerate(names):
            m = self.n @ state.values[name, "rotation"]
            shift = ((state.values[name, "translation"] - self.c) * self.n).sum(axis=1)
            residual += self.offset[:, k] * shift + (self.normal[:, k] * m).sum(axis=1)
            J[:, k, :3] = np.cross(self.normal[:, k], m)
            J[:, k, 3:] = self.offset[:, k, None] * self.n
        return residual, J


def _roots(inner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Roots S (c, 3, 3) of moments (c, 3, 3) = S^T S, and W with W S^T = 1, both zero where the moments are."""
    values, vectors = np.linalg.eigh(inner)
    used = values > LEAST_SPREAD * np.maximum(values[:, -1:], 1e-12)
    values = np.where(used, values, 1.0)
    axes = vectors.transpose(0, 2, 1) * used[:, :, None]
    return np.sqrt(values)[:, :, None] * axes, axes / np.sqrt(values)[:, :, None]


def _whitening(S: np.ndarray, inner: np.ndarray, flatness: float, L: int) -> np.ndarray:
    """(P L, 3, 3) whitening of sums, which the planes of the LiDARs move by S (P L, 3, 3). A plane deviates from that
    of the patch by `flatness` [m] at a point, so that its offset and slopes have flatness^2 times the inverse mean of
    `inner` (P L, 3, 3) as covariance (Zellner's g-prior)."""
    mean = inner.reshape(-1, L, 3, 3).sum(axis=1)
    mean /= mean[:, :1, :1]
    deviation = np.repeat(flatness**2 * np.linalg.inv(mean), L, axis=0)
    return np.linalg.inv(np.linalg.cholesky(np.eye(3) + S @ deviation @ S.transpose(0, 2, 1)))


def _free_of_planes(S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Patch (n,) and coefficients (n, 3 L) of combinations of whitened sums that depend on no plane. S (P, 3 L, 3):
    derivative of the sums by the plane; sums with a derivative of zero do not exist."""
    exists = (np.abs(S).sum(axis=2) > 0.0).astype(float)
    onto_planes = S @ np.linalg.pinv(S, rcond=1e-9)
    values, vectors = np.linalg.eigh(exists[:, :, None] * np.eye(S.shape[1]) - onto_planes)
    patch, column = np.nonzero(values > 0.5)
    return patch, vectors[patch, :, column]


@dataclass(frozen=True)
class PatchFactor(RowFactor):
    """Patches that several LiDARs see, of all stops. name: of the body; names: of all LiDARs; noise: of the body, whose
    flatness is that of all patches."""

    is_sparse: ClassVar[bool] = False
    units: ClassVar[Mapping[str, str]] = {}

    name: str
    names: tuple[str, ...]
    points: PatchPoints
    patches: PatchRows
    noise: LidarNoise
    starts: tuple[int, ...]
    n_keyframes: int
    layout: Layout
    imu: ImuData | None = None

    @classmethod
    def build(cls, noise: LidarNoise, at: Pass) -> PatchFactor:
        """The factor of all LiDARs in a pass."""
        streams = {s.name: true_points(s, at.state) for s in at.measurements.lidars}
        sigma = float(np.hypot(noise.sigma, noise.beam_sigma))
        points = PatchPoints.of(streams, at.state, sigma, GATE_SIGMAS * sigma)
        rows = PatchRows.of(points, tuple(streams), at.state, sigma, noise.flatness)
        name, n = at.rig.reference, len(at.state.seconds)
        return cls(name, tuple(streams), points, rows, noise, at.starts, n, at.layout)

    def measured_flatness(self, state: State) -> float:
        """The flatness [m] at which the chi^2 of the rows at `state` is their number less that of the parameters."""
        sigma, low, high = float(np.hypot(self.noise.sigma, self.noise.beam_sigma)), *FLATNESS_M
        free = np.count_nonzero(self._columns >= 0)
        while high > FLATNESS_STEP * low:
            middle = float(np.sqrt(low * high))
            rows = PatchRows.of(self.points, self.names, state, sigma, middle)
            out = output_at(replace(self, patches=rows), state)
            low, high = (middle, high) if chi2(out, slice(0, 1)) > len(rows.n) - free else (low, middle)
        return low

    @property
    def key(self) -> FactorKey:
        return self.name, ON_PATCHES

    @property
    def kinds(self) -> dict[str, slice]:
        return {ON_PATCHES: slice(0, 1)}

    def output(self) -> Whitened:
        return Whitened.empty(len(self.patches.n), 1)

    def times(self, state: State) -> np.ndarray:
        return state.seconds[self.patches.keyframe]

    @cached_property
    def _columns(self) -> np.ndarray:
        """Calibration columns of the poses of all LiDARs, -1 where fixed."""
        return np.concatenate([pose_columns(self.layout, name)[:6] for name in self.names])

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`."""
        total, into = 0.0, Into(piece, out, sums, curved)
        residual, J_poses = self.patches.at(self.names, state)
        for _, block in rows_by_recording(self.patches.keyframe, self.starts, self.n_keyframes, piece):
            n, keyframe = block.stop - block.start, self.patches.keyframe[block]
            J = np.zeros((n, 1, KEYFRAME_PAIR_DIM + 6 * len(self.names)))
            J[:, 0, KEYFRAME_PAIR_DIM:] = J_poses[block].reshape(n, -1)
            rows = Rows(residual[block, None], J)
            noise = RobustNoise(np.ones((n, 1, 1)), self.noise.loss, self.noise.loss_scale)
            total += add_rows(rows, block, rows.on_intervals(keyframe, self.n_keyframes), self._columns, noise, into)
        return total


# Patches of surface that several LiDARs at rest see.

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
    centre = _sums(cell.ravel(), n, points) / count.sum(axis=1, keepdims=True)
    order = np.argsort(-second, kind="stable")
    return centre[order[second[order] >= FEWEST_POINTS // 2]]


def _members(cloud: StopCloud, near: np.ndarray, noise_m: float, gate_m: float, radius_m: float) -> np.ndarray:
    """(m,) those of the points `near` that lie on one plane; none if they are not flat, or only one LiDAR sees it."""
    first = near[_on_plane(cloud, near, near, gate_m)[0]]  # of the plane through all; then of that through those on it
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
