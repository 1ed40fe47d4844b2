"""Planes in a cloud of points that is roughly in place, and which points lie on which.

Voxels that are flat grow into regions, regions of one plane are joined, those that bend are dropped. Points then belong
to a plane by their distance, within squares of the plane itself: cells in space would cut a noisy wall into layers.
Points near two planes, in grazing beams, and in squares that are not flat belong to none. A wall has two sides: a plane
is seen from the side that its normal points to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.detection.plane_kernels import (
    LARGEST_TURN,
    MOMENTS,
    NEAR,
    OUTSIDE,
    OWN,
    Cells,
    Voxels,
    associate,
    fit,
    grow,
    sum_cells,
    sum_voxels,
)
from icalib.geometry.planes import plane_of, tangents

MOST_POINTS = 2_000_000  # that the search looks at
FEWEST = 12  # points of a voxel or a cell
FEWEST_BENT = 9  # voxels that show whether a region bends
ROUNDS = 3  # of association and fit
ACROSS = 0.25  # of a voxel's edge: what spreads less in its own plane is a line
SAME_TURN = np.deg2rad(4.0)  # between regions of one plane
MIXED = 1.35  # whitened RMS of a cell that does not hold one plane
BENT = 0.4  # standard deviations of a point by which a region may bow: flat ones up to 0.32, hills from 0.4 on


@dataclass(frozen=True)
class PlaneSearch:
    """noise_m of a point; how far the cloud is out of place: position_m, and angle_rad about the sensor. voxel_m: edge
    of voxels and cells; smallest_m2: of a plane's cells together; gate: standard deviations from a point to its plane.
    """

    noise_m: float = 0.03
    position_m: float = 0.01
    angle_rad: float = 0.005
    voxel_m: float = 0.3
    smallest_m2: float = 0.7
    gate: float = 3.0
    least_cosine: float = 0.1

    def variance(self, points: np.ndarray, seen_from: np.ndarray) -> np.ndarray:
        """(N,) m^2, what points (N, 3) seen from (N, 3) may be off."""
        range2 = ((points - seen_from) ** 2).sum(axis=1)
        return self.noise_m**2 + self.position_m**2 + self.angle_rad**2 * range2


@dataclass(frozen=True)
class FoundPlanes:
    """planes (P, 6): normal, towards whoever saw it, and centroid, world; cells: where they are."""

    cells: Cells

    @property
    def planes(self) -> np.ndarray:
        return self.cells.planes

    @property
    def areas_m2(self) -> np.ndarray:
        """(P,) of the cells of each."""
        edges = np.append(self.cells.first, len(self.cells.use))
        before = np.append(0, np.cumsum(self.cells.use == OWN))
        return np.diff(before[edges]) * self.cells.edge_m**2

    def of_points(self, points: np.ndarray, seen_from: np.ndarray, search: PlaneSearch) -> np.ndarray:
        """(N,) int32, the plane of each of points (N, 3) seen from (N, 3), world; -1: none."""
        return _associate(self.cells, points, seen_from, search)[0]


def find_planes(points: np.ndarray, seen_from: np.ndarray, search: PlaneSearch = PlaneSearch()) -> FoundPlanes:
    """Planes of points (N, 3) seen from (N, 3), both in the world frame; the largest first."""
    step = max(1, len(points) // MOST_POINTS)
    points, seen_from = points[::step], seen_from[::step]
    if not len(points):
        return FoundPlanes(_packed([], [], [], [], [], search.voxel_m))
    voxels = _voxels(points, seen_from, search)
    region = np.full(len(voxels.centre), -1, dtype=np.int64)
    count = grow(voxels, np.argsort(voxels.sigma, kind="stable"), region)
    members = [
        np.flatnonzero(region == k) for k in np.flatnonzero(np.bincount(region[region >= 0], minlength=count) > 2)
    ]
    cells = _cells(_join(voxels, members), voxels, search)
    for _ in range(ROUNDS):
        cells = _refined(cells, points, seen_from, search)
    return FoundPlanes(cells)


def _voxels(points: np.ndarray, seen_from: np.ndarray, search: PlaneSearch) -> Voxels:
    ijk = np.floor(points / search.voxel_m).astype(np.int64)
    ijk -= ijk.min(axis=0) - 1
    shape = ijk.max(axis=0) + 2
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    keys, which = np.unique(ijk @ strides, return_inverse=True)
    n = len(keys)
    moments, towards, variance = np.zeros((n, MOMENTS)), np.zeros((n, 3)), np.zeros(n)
    sum_voxels(points, seen_from, search.variance(points, seen_from), which, moments, towards, variance)
    count = moments[:, 0]
    S = moments[:, [2, 4, 7, 4, 5, 8, 7, 8, 9]].reshape(n, 3, 3) / count[:, None, None]
    centre = moments[:, [1, 3, 6]] / count[:, None]
    spread, axes = np.linalg.eigh(S - centre[:, :, None] * centre[:, None, :])
    normal = axes[:, :, 0] * np.sign((axes[:, :, 0] * towards).sum(axis=1, keepdims=True))
    sigma = np.sqrt(variance / count)
    thin = spread[:, 0] < np.minimum((MIXED * sigma) ** 2, 0.25 * spread[:, 1])
    flat = (count >= FEWEST) & thin & (spread[:, 1] > (ACROSS * search.voxel_m) ** 2 / 3.0)
    around = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if i or j or k]) @ strides
    at = np.searchsorted(keys, keys[:, None] + around).clip(max=n - 1)
    neighbour = np.where(keys[at] == keys[:, None] + around, at, -1)
    return Voxels(moments, np.ascontiguousarray(normal), centre, sigma, neighbour, flat)


@dataclass(frozen=True)
class _Region:
    """Voxels (m,) on one plane."""

    members: np.ndarray
    normal: np.ndarray
    centre: np.ndarray
    sigma: float

    @classmethod
    def of(cls, voxels: Voxels, members: np.ndarray) -> _Region:
        normal, centre = voxels.normal[members].sum(axis=0), np.empty(3)
        fit(voxels.moments[members].sum(axis=0), normal, centre)
        return cls(members, normal, centre, float(np.sqrt((voxels.sigma[members] ** 2).mean())))

    def is_plane_of(self, other: _Region) -> bool:
        """Whether the other may lie on the same plane."""
        gap = other.centre - self.centre
        near = max(abs(self.normal @ gap), abs(other.normal @ gap)) < self.sigma + other.sigma
        return bool(self.normal @ other.normal > np.cos(SAME_TURN) and near)

    def bends(self, voxels: Voxels) -> bool:
        """Whether a quadratic surface through the voxels' centres bows."""
        gap, axes = voxels.centre[self.members] - self.centre, tangents(self.normal)
        u, v = axes @ gap.T
        if len(u) < FEWEST_BENT:
            return False
        A = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
        root = np.sqrt(voxels.moments[self.members, 0])
        x, *_ = np.linalg.lstsq(A * root[:, None], gap @ self.normal * root, rcond=None)
        bow = A[:, 3:] @ x[3:]
        return bool(0.5 * np.ptp(bow - A[:, :3] @ np.linalg.lstsq(A[:, :3], bow, rcond=None)[0]) > BENT * self.sigma)

    def continues(self, voxels: Voxels, bent: np.ndarray) -> bool:
        """Whether it is the rest of a larger surface that bends; bent (V,) voxels."""
        around = voxels.neighbour[self.members]
        alike = voxels.normal[around] @ self.normal > np.cos(LARGEST_TURN)
        return bool((alike & bent[around] & (around >= 0)).any())


def _join(voxels: Voxels, members: list[np.ndarray]) -> list[_Region]:
    """Regions of the same plane as one; the largest take the others in."""
    open_regions = sorted((_Region.of(voxels, m) for m in members), key=lambda r: -len(r.members))
    joined: list[_Region] = []
    for region in open_regions:
        for k, other in enumerate(joined):
            if other.is_plane_of(region):
                joined[k] = _Region.of(voxels, np.concatenate([other.members, region.members]))
                break
        else:
            joined.append(region)
    return sorted(joined, key=lambda r: -len(r.members))


def _cells(regions: list[_Region], voxels: Voxels, search: PlaneSearch) -> Cells:
    """The squares that the voxels of regions lie in, and those around them; bent and small regions are left out."""
    planes, axes, low, size, use = [], [], [], [], []
    bent = np.zeros(len(voxels.centre), dtype=bool)
    for region in regions:
        if region.bends(voxels) or region.continues(voxels, bent):
            bent[region.members] = True
            continue
        across = tangents(region.normal)
        uv = (voxels.centre[region.members] - region.centre) @ across.T
        start = uv.min(axis=0) - 1.5 * search.voxel_m
        ij = np.floor((uv - start) / search.voxel_m).astype(int)
        grid = np.full(ij.max(axis=0) + 2, OUTSIDE, dtype=np.uint8)
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                grid[ij[:, 0] + i, ij[:, 1] + j] = OWN
        planes.append(plane_of(region.normal, region.centre))
        axes.append(across)
        low.append(start)
        size.append(grid.shape)
        use.append(grid.ravel())
    return _packed(planes, axes, low, size, use, search.voxel_m)


def _packed(planes: list, axes: list, low: list, size: list, use: list, edge_m: float) -> Cells:
    first = np.cumsum([0, *(len(u) for u in use)])[:-1].astype(np.int64)
    return Cells(
        np.array(planes).reshape(-1, 6),
        np.array(axes).reshape(-1, 2, 3),
        np.array(low).reshape(-1, 2),
        np.array(size, dtype=np.int64).reshape(-1, 2),
        first,
        np.concatenate(use) if use else np.zeros(0, dtype=np.uint8),
        edge_m,
    )


def _associate(
    cells: Cells, points: np.ndarray, seen_from: np.ndarray, search: PlaneSearch
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = len(points)
    plane, cell, distance = np.empty(n, np.int32), np.empty(n, np.int64), np.empty(n)
    variance = search.variance(points, seen_from)
    associate(points, seen_from, variance, cells, search.gate, search.least_cosine, plane, cell, distance)
    return plane, cell, distance


def _refined(cells: Cells, points: np.ndarray, seen_from: np.ndarray, search: PlaneSearch) -> Cells:
    """Planes fitted to their own points, without cells that are empty or not flat, and without planes that are small;
    cells stay where they are."""
    plane, cell, distance = _associate(cells, points, seen_from, search)
    stats, moments = np.zeros((len(cells.use), 3)), np.zeros((len(cells.planes), MOMENTS))
    sum_cells(points, search.variance(points, seen_from), plane, cell, distance, stats, moments)
    count = stats[:, 0]
    good = (count >= FEWEST) & (stats[:, 2] < MIXED**2 * count)
    use = np.where(cells.use == OUTSIDE, OUTSIDE, np.where(good, OWN, NEAR)).astype(np.uint8)
    found: tuple[list, list, list, list, list] = ([], [], [], [], [])
    for q, (i, j) in enumerate(cells.size):
        own = slice(cells.first[q], cells.first[q] + i * j)
        if (use[own] == OWN).sum() * search.voxel_m**2 < search.smallest_m2:
            continue
        normal, centre = cells.planes[q, :3].copy(), np.empty(3)
        fit(moments[q], normal, centre)
        # The cells' frame stays at the old point: the new one is where the normal through it meets the plane.
        at = cells.planes[q, 3:] + normal * (normal @ (centre - cells.planes[q, 3:]))
        for into, value in zip(
            found, (np.append(normal, at), cells.axes[q], cells.low[q], (i, j), use[own]), strict=True
        ):
            into.append(value)
    return _packed(*found, search.voxel_m)
