"""Pose of one LiDAR in the frame of another from clouds of the same scene, from nothing.

Both clouds give surface elements (surfels): points with the normal of their neighbourhood. Rotations come first, as in
extended Gaussian images (Horn, 1984): of a grid over all rotations, those that turn normals onto normals are
candidates.
For each, translations are searched on a grid, by distances to the nearest point. Point-to-plane ICP refines them (Chen
and Medioni, 1992). Surfels are drawn with equal weight in all directions (normal-space sampling, Rusinkiewicz and
Levoy, 2001): otherwise the ground outvotes the walls. The candidate that explains most surfels of all stops is the
pose. If another one explains nearly as many, the pose is ambiguous.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree

from icalib.geometry import so3
from icalib.motion.factor import Extrinsics

# Surfels of a cloud.

CELL_M = 0.25  # edge of the cells whose centroids stand for their points
NEIGHBOURS = 16  # cells that give the normal; rings on the ground are apart by several cells
FLAT_RATIO, LINE_RATIO = 0.02, 0.02  # of variances: across to along a surface, at most; and along it, at least
ROUGH_M = 0.08  # largest standard deviation across a surface: curbs and hedges have more
FARTHEST_M = 60.0  # beyond, rings are too far apart for normals
N_DIRECTIONS = 2000  # of the sphere, 4.5 deg apart
Z_STEPS, AZIMUTHS = 401, 721  # of the table of nearest directions, finer than these
BLUR_RAD = np.deg2rad(6.0)  # of normals, whose error it is


@cache
def _directions() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors (N_DIRECTIONS, 3) in a Fibonacci lattice, the number of the nearest one by z and azimuth, and the
    kernel that blurs histograms."""
    unit = _fibonacci(N_DIRECTIONS)
    z, azimuth = np.meshgrid(np.linspace(-1.0, 1.0, Z_STEPS), np.linspace(-np.pi, np.pi, AZIMUTHS), indexing="ij")
    across = np.sqrt(1.0 - z * z)
    nearest = KDTree(unit).query(np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=-1))[1]
    return unit, np.asarray(nearest), np.exp((unit @ unit.T - 1.0) / BLUR_RAD**2)


def _nearest_direction(unit: np.ndarray) -> np.ndarray:
    """(...,) number of the direction nearest to each of the unit vectors (..., 3)."""
    z = np.clip(0.5 * (Z_STEPS - 1) * (unit[..., 2] + 1.0), 0.0, Z_STEPS - 1.0)
    azimuth = (AZIMUTHS - 1) * (np.arctan2(unit[..., 1], unit[..., 0]) / (2.0 * np.pi) + 0.5)
    return _directions()[1][np.rint(z).astype(int), np.rint(azimuth).astype(int)]


def _fibonacci(n: int) -> np.ndarray:
    """(n, 3) unit vectors, evenly over the sphere."""
    k = np.arange(n) + 0.5
    z, turn = 1.0 - 2.0 * k / n, np.pi * (1.0 + np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def cell_centroids(xyz: np.ndarray, edge_m: float) -> np.ndarray:
    """(n, 3) centroids of the points xyz (N, 3) m in each cubic cell that has some."""
    _, cell, count = np.unique(np.floor(xyz / edge_m), axis=0, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(cell.ravel(), column) for column in xyz.T], axis=1) / count[:, None]


@dataclass(frozen=True)
class Surfels:
    """Surfels of one cloud. point (n, 3) m: centroids of cells; flat (f,): indices of those on a surface; normal
    (f, 3): towards the LiDAR."""

    point: np.ndarray
    flat: np.ndarray
    normal: np.ndarray

    @classmethod
    def of(cls, xyz: np.ndarray) -> Surfels:
        """Surfels of a cloud xyz (N, 3) m."""
        xyz = xyz[np.linalg.norm(xyz, axis=1) < FARTHEST_M].astype(np.float64)
        point = cell_centroids(xyz, CELL_M)
        if len(point) < NEIGHBOURS:
            return cls(np.zeros((0, 3)), np.zeros(0, int), np.zeros((0, 3)))
        near = point[KDTree(point).query(point, k=NEIGHBOURS)[1]]
        near -= near.mean(axis=1, keepdims=True)
        variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near) / NEIGHBOURS)
        across, along, length = variance.T
        flat = np.flatnonzero((across < FLAT_RATIO * along) & (along > LINE_RATIO * length) & (across < ROUGH_M**2))
        normal = axes[flat, :, 0]
        return cls(point, flat, -np.copysign(1.0, (normal * point[flat]).sum(axis=1))[:, None] * normal)

    @cached_property
    def place(self) -> np.ndarray:
        """(f, 3) points of the flat surfels [m]."""
        return self.point[self.flat]

    @cached_property
    def tree(self) -> KDTree:
        return KDTree(self.place)

    @cached_property
    def _density(self) -> tuple[np.ndarray, np.ndarray]:
        """Blurred number of normals in each direction, and the direction (f,) of each normal."""
        kernel, nearest = _directions()[2], _nearest_direction(self.normal)
        return kernel @ np.bincount(nearest, minlength=N_DIRECTIONS), nearest

    @property
    def image(self) -> np.ndarray:
        """(N_DIRECTIONS,) extended Gaussian image; the root keeps walls beside the ground."""
        density = self._density[0]
        return np.sqrt(density / density.max())

    def sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """(m,) at most n flat surfels, drawn with equal weight in all directions."""
        weight = 1.0 / self._density[0][self._density[1]]
        n = min(n, len(self.flat))
        return np.sort(rng.choice(len(self.flat), n, replace=False, p=weight / weight.sum()))

    @cached_property
    def distances(self) -> _Distances:
        return _Distances.of(self.point)


@dataclass(frozen=True)
class _Distances:
    """Distances [m] to the nearest point on a grid that starts at `low` (3,) m, at most FAR_M."""

    grid: np.ndarray
    low: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> _Distances:
        low = np.clip(points.min(axis=0), -FIELD_M, 0.0) - FAR_M
        shape = np.ceil((np.clip(points.max(axis=0), 0.0, FIELD_M) + FAR_M - low) / GRID_M).astype(int)
        empty, at = np.ones(shape, bool), np.floor((points - low) / GRID_M).astype(int)
        empty[tuple(at[((at >= 0) & (at < shape)).all(axis=1)].T)] = False
        cells = np.asarray(distance_transform_edt(empty), np.float32)
        return cls(np.minimum(GRID_M * cells, FAR_M), low)

    def mean(self, points: np.ndarray) -> np.ndarray:
        """(m,) mean distances of points (m, n, 3)."""
        at = np.floor((points - self.low) / GRID_M).astype(np.int32)
        inside = ((at >= 0) & (at < self.grid.shape)).all(axis=2)
        at[~inside] = 0
        return np.where(inside, self.grid[at[..., 0], at[..., 1], at[..., 2]], FAR_M).mean(axis=1)


# Candidates, refined and compared.

GRID_M, FAR_M, FIELD_M = 0.5, 1.5, 45.0  # edge of cells, largest distance, and largest extent of distances
STEP_RAD = np.deg2rad(10.0)  # of the grid of rotations; ICP converges from there
SHIFT_M, SHIFT_STEP_M = 2.5, 0.5  # largest translation along each axis, and step: LiDARs of one robot. ICP goes farther
N_ROTATIONS = 24  # candidates: all turns about the vertical, 15 deg apart
APART_RAD, APART_M = np.deg2rad(15.0), 1.0  # candidates that differ by less are one
SLIDES_M = (-2.4, -1.6, -0.8, -0.4, 0.4, 0.8, 1.6, 2.4)
SAME_RAD, SAME_M = np.deg2rad(3.0), 0.3  # results that differ by less are one
MOST_NORMALS = 150  # directions of the denser part of an image that are compared
N_REFINED = 6  # best candidates that are refined with narrow gates
GATES_M = (2.0, 1.0, 0.3)  # of ICP, one after another
ICP_STEPS = 6  # with each gate
N_SAMPLES = 400  # surfels of a stop
MOST_STOPS = 6  # that the search uses
SCORE_M, REACH_M = 0.2, 1.0  # distance from the other surface at which a surfel is not explained; and from its surfel
SAME_NORMAL = np.cos(np.deg2rad(25.0))
AMBIGUOUS = 0.85  # score of another pose over the best. Wrong poses reach 0.7 on streets, and 1 in symmetric rooms
LEAST_SCORE = 0.2  # of the surfels that must be explained: a quarter to two thirds are where fields of view overlap


@dataclass(frozen=True)
class Pair:
    """Surfels of two LiDARs at one stop: of the reference, and of the one whose pose is wanted. sample (m,): surfels of
    the latter in use; scene (k, 3): further points for distances."""

    reference: Surfels
    other: Surfels
    sample: np.ndarray
    scene: np.ndarray

    @classmethod
    def of(cls, reference: Surfels, other: Surfels, rng: np.random.Generator) -> Pair:
        sample = other.sample(N_SAMPLES, rng)
        rough = np.delete(other.point, other.flat, axis=0)
        rough = rough[rng.permutation(len(rough))[: len(sample) // 3]]
        return cls(reference, other, sample, np.concatenate([other.place[sample[::3]], rough]))

    def matches(self, pose: Extrinsics, gate_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Surfels in use near one of the reference: points (k, 3), normals (k, 3) there, distances (k,) along these,
        and cosines (k,) between the normals of both."""
        x, normal = self.other.place[self.sample], self.other.normal[self.sample] @ pose.R.T
        y = x @ pose.R.T + pose.p
        far, k = map(np.asarray, self.reference.tree.query(y, distance_upper_bound=gate_m))
        near, k = np.isfinite(far), k[np.isfinite(far)]
        n = self.reference.normal[k]
        off = ((y[near] - self.reference.place[k]) * n).sum(axis=1)
        return x[near], n, off, (normal[near] * n).sum(axis=1)


@dataclass(frozen=True)
class Registration:
    """The pose that explains most. scores (stops,): share of the surfels explained at each stop. rival: the best other
    pose, and its mean score."""

    pose: Extrinsics
    scores: np.ndarray
    rival: tuple[Extrinsics, float] | None

    @property
    def score(self) -> float:
        return float(self.scores.mean())

    def inverse(self) -> Registration:
        """The pose of the reference in the frame of the other LiDAR."""
        rival = self.rival and (_inverse(self.rival[0]), self.rival[1])
        return Registration(_inverse(self.pose), self.scores, rival)

    @property
    def is_ambiguous(self) -> bool:
        return self.rival is not None and self.rival[1] > AMBIGUOUS * self.score


def _inverse(pose: Extrinsics) -> Extrinsics:
    return Extrinsics(pose.R.T, -pose.R.T @ pose.p)


def register(reference: Sequence[Surfels], other: Sequence[Surfels]) -> Registration | None:
    """The pose of the LiDAR `other` in the frame of `reference` from the surfels of both at each stop; None if they
    have none."""
    rng = np.random.default_rng(0)
    pairs = [Pair.of(a, b, rng) for a, b in zip(reference, other, strict=True) if len(a.flat) and len(b.flat)]
    if not pairs:
        return None
    used = pairs[:: -(-len(pairs) // MOST_STOPS)]
    coarse = [_refined(used, pose, GATES_M[:1]) for pose in _candidates(used)]
    coarse = sorted(coarse, key=lambda pose: -_scores(used, pose, GATES_M[1]).mean())
    fine: list[Extrinsics] = []
    for pose in coarse:
        if len(fine) < N_REFINED and all(differ(pose, f, APART_RAD, APART_M) for f in fine):
            fine.append(pose)
    fine = sorted((_refined(used, pose, GATES_M[1:]) for pose in fine), key=lambda pose: -_scores(used, pose).mean())
    slid = [_refined(used, pose, GATES_M[1:]) for pose in _slid(used, fine[0])]
    ranked = sorted((*fine, *slid), key=lambda pose: -_scores(used, pose).mean())
    others = [pose for pose in ranked[1:] if differ(pose, ranked[0], SAME_RAD, SAME_M)]
    rival = (others[0], float(_scores(used, others[0]).mean())) if others else None
    return Registration(ranked[0], _scores(pairs, ranked[0]), rival)


def _slid(pairs: Sequence[Pair], pose: Extrinsics) -> list[Extrinsics]:
    """Poses moved along the direction that the surfaces constrain least: walls of a street hardly show it."""
    normals = [pair.matches(pose, REACH_M)[1] for pair in pairs]
    weakest = np.linalg.eigh(sum(n.T @ n for n in normals))[1][:, 0]
    return [Extrinsics(pose.R, pose.p + shift * weakest) for shift in SLIDES_M]


def differ(a: Extrinsics, b: Extrinsics, angle_rad: float, distance_m: float) -> bool:
    """Whether two poses differ by more than an angle or a distance."""
    turn = np.linalg.norm(so3.log(np.ascontiguousarray(a.R.T @ b.R)))
    return bool(turn > angle_rad or np.linalg.norm(a.p - b.p) > distance_m)


def _candidates(pairs: Sequence[Pair]) -> list[Extrinsics]:
    """Poses with the rotations that turn normals onto normals best, each with its best translation."""
    rotations, score = _rotation_grid(), 0.0
    directions = _directions()[0]
    for pair in pairs:
        image, weight = pair.reference.image, pair.other.image
        k = np.argsort(-weight)[:MOST_NORMALS]
        turned = _nearest_direction(np.einsum("gij,mj->gmi", rotations, directions[k]))
        score = score + image[turned] @ weight[k] / weight[k].sum()
    chosen: list[np.ndarray] = []
    for g in np.argsort(-np.asarray(score)):
        R = rotations[g]
        if all((np.einsum("ij,ij->", R, c) - 1.0) / 2.0 < np.cos(APART_RAD) for c in chosen):
            chosen.append(R)
        if len(chosen) == N_ROTATIONS:
            break
    return [Extrinsics(R, _translation(pairs, R)) for R in chosen]


@cache
def _rotation_grid() -> np.ndarray:
    """(g, 3, 3) rotations, STEP_RAD apart: axes z over the sphere, each with all turns about it."""
    axes = _fibonacci(int(4.0 * np.pi / STEP_RAD**2))
    turns = np.arange(0.0, 2.0 * np.pi, STEP_RAD)
    least = np.eye(3)[np.argmin(np.abs(axes), axis=1)]
    x = np.cross(axes, least)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(axes, x)
    c, s = np.cos(turns)[:, None, None], np.sin(turns)[:, None, None]
    z = np.broadcast_to(axes, (len(turns), *axes.shape))
    return np.stack([c * x + s * y, c * y - s * x, z], axis=-1).reshape(-1, 3, 3)


def _translation(pairs: Sequence[Pair], R: np.ndarray) -> np.ndarray:
    """(3,) translation on a grid with the least mean distance of points, turned by R, from the other cloud."""
    steps = np.arange(-SHIFT_M, SHIFT_M + 1e-9, SHIFT_STEP_M)
    shifts = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    total = sum(pair.reference.distances.mean(pair.scene @ R.T + shifts) for pair in pairs)
    return shifts[int(np.argmin(total)), 0]


def _refined(pairs: Sequence[Pair], pose: Extrinsics, gates_m: Sequence[float]) -> Extrinsics:
    """The pose after ICP with Tukey's weights, whose scale are the gates."""
    for gate_m in gates_m:
        for _ in range(ICP_STEPS):
            H, g = 1e-6 * np.eye(6), np.zeros(6)
            for pair in pairs:
                x, normal, off, cosine = pair.matches(pose, 2.0 * gate_m)
                weight = (cosine > 0.5) * np.maximum(0.0, 1.0 - (off / gate_m) ** 2) ** 2
                n = normal @ pose.R
                J = np.concatenate([np.cross(x, n), n], axis=1)
                H, g = H + (J * weight[:, None]).T @ J, g + J.T @ (weight * off)
            step = -np.linalg.solve(H, g)
            pose = Extrinsics(pose.R @ so3.exp(step[:3]), pose.p + pose.R @ step[3:])
    return pose


def _scores(pairs: Sequence[Pair], pose: Extrinsics, gate_m: float = SCORE_M) -> np.ndarray:
    """(stops,) share of the surfels in use that the pose explains, with Tukey's weights."""
    out = np.zeros(len(pairs))
    for k, pair in enumerate(pairs):
        _, _, off, cosine = pair.matches(pose, max(REACH_M, gate_m))
        explained = (cosine > SAME_NORMAL) * np.maximum(0.0, 1.0 - (off / gate_m) ** 2) ** 2
        out[k] = explained.sum() / len(pair.sample)
    return out
