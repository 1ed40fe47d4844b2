"""Planes in point clouds.

Compiled parts of the search for planes: moments of voxels, growth of regions, association of points with planes.

Planes in a roughly registered point cloud, and the points that lie on each.

Flat voxels grow into regions, regions of one plane are joined, and regions that bend are dropped. Points are then
associated with a plane by their distance to it, within square cells on the plane; voxels would cut a noisy wall into
layers. Points near two planes, in grazing beams, or in cells that are not flat belong to no plane. Both sides of a wall
are separate planes: a plane is visible only from the side that its normal points to.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.planes import plane_of, tangents

MOST_POINTS = 2_000_000  # points that the search uses, at most
FEWEST_IN_VOXEL = 12  # points of a voxel or a cell, at least
FEWEST_BENT = 9  # voxels of a region whose bend is tested, at least
FIT_ROUNDS = 3  # rounds of association and fit
LEAST_ELONGATION = 0.25  # of a voxel's edge: points that spread less within their plane form a line
SAME_TURN = np.deg2rad(4.0)  # largest angle between the normals of regions of one plane
MIXED_CELL_RMS = 1.35  # whitened RMS above which a cell does not hold a single plane
# registration error of the cloud, at most, to test for unevenness; with a larger one, the test shows nothing
FINE_M = 1e-3
# unevenness that most points must be below; otherwise poses or times of points are wrong, and no plane is rejected
EVEN_CELLS = 0.1
BENT_REGION = 0.4  # largest bow of a region, in standard deviations of a point: flat ones up to 0.32, hills from 0.4 on
# Largest unevenness of a plane (`_unevenness`): 99 % of planes in 39 simulated recordings up to 0.12, hills from 0.23
UNEVEN_CELLS = 0.2


@dataclass(frozen=True)
class PlaneSearch:
    """Settings of the search. noise_m: standard deviation of a point. position_m, angle_rad: registration error of the
    cloud, the angle about the sensor. voxel_m: edge of voxels and cells. smallest_m2: least total area of a plane's
    cells. gate: largest distance from a point to its plane, in standard deviations. least_cosine: of the angle between
    beam and normal; beams below it are grazing."""

    noise_m: float = 0.03
    position_m: float = 0.01
    angle_rad: float = 0.005
    voxel_m: float = 0.3
    smallest_m2: float = 0.7
    gate: float = 3.0
    least_cosine: float = 0.1

    def variance(self, points: np.ndarray, origins: np.ndarray) -> np.ndarray:
        """(N,) m^2: variance of points (N, 3), by noise and registration error. origins (N, 3): sensor positions."""
        range2 = ((points - origins) ** 2).sum(axis=1)
        return self.noise_m**2 + self.position_m**2 + self.angle_rad**2 * range2


@dataclass(frozen=True)
class ExtractedPlanes:
    """cells: the cells of all surfaces. The first `count` surfaces are planes; the other ones bend or are small, and
    only keep their points from being associated with neighbouring planes."""

    cells: OccupancyGrid
    count: int

    @property
    def planes(self) -> np.ndarray:
        """(P, 6) normal, towards the sensor, and a point near the centroid [m], in the world frame."""
        return self.cells.planes[: self.count]

    @property
    def areas_m2(self) -> np.ndarray:
        """(P,) total area of the cells of each plane."""
        edges = np.append(self.cells.first, len(self.cells.use))
        before = np.append(0, np.cumsum(self.cells.use == INSIDE))
        return np.diff(before[edges])[: self.count] * self.cells.edge_m**2

    def of_points(self, points: np.ndarray, origins: np.ndarray, search: PlaneSearch) -> np.ndarray:
        """(N,) int32: plane of each of points (N, 3) with sensor positions `origins` (N, 3), in the world frame; -1 for
        none."""
        return _associate(self.cells, points, origins, search)[0]

    def share_seen_through(
        self, points: np.ndarray, origins: np.ndarray, plane: np.ndarray, search: PlaneSearch
    ) -> float:
        """Share of the points on planes whose beams passed through another plane; see `seen_through`. plane (N,): of
        each point."""
        count = seen_through(points, origins, plane, EXCLUSIVE_GATES * search.gate * search.noise_m, self.cells)
        return count / max(np.count_nonzero(plane >= 0), 1)


def find_planes(points: np.ndarray, origins: np.ndarray, search: PlaneSearch = PlaneSearch()) -> ExtractedPlanes:
    """Planes of points (N, 3) with sensor positions `origins` (N, 3), both in the world frame [m]; the plane with most
    cells first."""
    step = max(1, len(points) // MOST_POINTS)
    points, origins = points[::step], origins[::step]
    if not len(points):
        return ExtractedPlanes(_packed([], search.voxel_m), 0)
    variance = search.variance(points, origins)
    voxels = _voxels(points, origins, variance, search)
    region = np.full(len(voxels.centre), -1, dtype=np.int64)
    count = grow(voxels, np.argsort(voxels.sigma, kind="stable"), region)
    members = [
        np.flatnonzero(region == k) for k in np.flatnonzero(np.bincount(region[region >= 0], minlength=count) > 2)
    ]
    # regions of three or more voxels become patches: a plane with a grid of cells that its points occupy
    patches = _patches(_join(voxels, members), voxels, search)
    for k in range(FIT_ROUNDS):
        patches = _refined(patches, points, origins, variance, search, k == FIT_ROUNDS - 1)
    # bent, uneven and small surfaces have lost the cells that belong to them, and do not count as planes
    return ExtractedPlanes(_packed(patches, search.voxel_m), sum(p.n_inside > 0 for p in patches))


def _voxels(points: np.ndarray, origins: np.ndarray, variance: np.ndarray, search: PlaneSearch) -> Voxels:
    """Moments and local planes of all voxels that contain points. variance (N,) m^2: of the points."""
    ijk = np.floor(points / search.voxel_m).astype(np.int64)
    ijk -= ijk.min(axis=0) - 1
    shape = ijk.max(axis=0) + 2
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    keys, which = np.unique(ijk @ strides, return_inverse=True)
    n = len(keys)
    moments, towards, total = np.zeros((n, MOMENTS)), np.zeros((n, 3)), np.zeros(n)
    sum_voxels(points, origins, variance, which, moments, towards, total)
    count = moments[:, 0]
    S = moments[:, [2, 4, 7, 4, 5, 8, 7, 8, 9]].reshape(n, 3, 3) / count[:, None, None]
    centre = moments[:, [1, 3, 6]] / count[:, None]
    spread, axes = np.linalg.eigh(S - centre[:, :, None] * centre[:, None, :])
    normal = axes[:, :, 0] * np.sign((axes[:, :, 0] * towards).sum(axis=1, keepdims=True))
    sigma = np.sqrt(total / count)
    thin = spread[:, 0] < np.minimum((MIXED_CELL_RMS * sigma) ** 2, 0.25 * spread[:, 1])
    flat = (count >= FEWEST_IN_VOXEL) & thin & (spread[:, 1] > (LEAST_ELONGATION * search.voxel_m) ** 2 / 3.0)
    around = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if i or j or k]) @ strides
    at = np.searchsorted(keys, keys[:, None] + around).clip(max=n - 1)
    neighbour = np.where(keys[at] == keys[:, None] + around, at, -1)
    return Voxels(moments, np.ascontiguousarray(normal), centre, sigma, neighbour, flat)


@dataclass(frozen=True)
class _Region:
    """Voxels (m,) on one plane, with its normal and centre; sigma: RMS standard deviation [m] of their points."""

    members: np.ndarray
    normal: np.ndarray
    centre: np.ndarray
    sigma: float

    @classmethod
    def of(cls, voxels: Voxels, members: np.ndarray) -> _Region:
        """The region of the voxels `members` (m,), with the least-squares plane of their points."""
        normal, centre = voxels.normal[members].sum(axis=0), np.empty(3)
        fit(voxels.moments[members].sum(axis=0), normal, centre)
        return cls(members, normal, centre, float(np.sqrt((voxels.sigma[members] ** 2).mean())))

    def is_plane_of(self, other: _Region) -> bool:
        """Whether both regions may lie on the same plane."""
        gap = other.centre - self.centre
        near = max(abs(self.normal @ gap), abs(other.normal @ gap)) < self.sigma + other.sigma
        return bool(self.normal @ other.normal > np.cos(SAME_TURN) and near)

    def bends(self, voxels: Voxels) -> bool:
        """Whether the quadratic surface fitted to the voxels' centres deviates from a plane by more than
        BENT_REGION."""
        gap, axes = voxels.centre[self.members] - self.centre, tangents(self.normal)
        u, v = axes @ gap.T
        if len(u) < FEWEST_BENT:
            return False
        A = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
        root = np.sqrt(voxels.moments[self.members, 0])
        x, *_ = np.linalg.lstsq(A * root[:, None], gap @ self.normal * root, rcond=None)
        bow = A[:, 3:] @ x[3:]
        return bool(
            0.5 * np.ptp(bow - A[:, :3] @ np.linalg.lstsq(A[:, :3], bow, rcond=None)[0]) > BENT_REGION * self.sigma
        )

    def continues(self, voxels: Voxels, bent: np.ndarray) -> bool:
        """Whether the region is a part of a larger surface that bends. bent (V,): voxels of such surfaces."""
        around = voxels.neighbour[self.members]
        alike = voxels.normal[around] @ self.normal > np.cos(LARGEST_TURN)
        return bool((alike & bent[around] & (around >= 0)).any())


def _join(voxels: Voxels, members: list[np.ndarray]) -> list[_Region]:
    """Merges regions of one plane into the largest of them; returns the largest region first."""
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


@dataclass(frozen=True)
class _Patch:
    """A plane (6,) and its cells: use (i, j), a grid along axes (2, 3) that starts at `low` (2,) m from the plane's
    point."""

    plane: np.ndarray
    axes: np.ndarray
    low: np.ndarray
    use: np.ndarray

    @property
    def n_inside(self) -> int:
        """Number of cells that belong to the plane."""
        return int((self.use == INSIDE).sum())

    def as_exclusion_zone(self) -> _Patch:
        """The patch without cells of its plane: it gets no points, but keeps other planes from getting them."""
        return replace(self, use=np.minimum(self.use, NEAR))


def _patches(regions: list[_Region], voxels: Voxels, search: PlaneSearch) -> list[_Patch]:
    """The cells that contain voxels of the regions, and those around them. Bent regions get no cells of their plane."""
    patches, bent = [], np.zeros(len(voxels.centre), dtype=bool)
    for region in regions:
        across = tangents(region.normal)
        uv = (voxels.centre[region.members] - region.centre) @ across.T
        low = uv.min(axis=0) - 1.5 * search.voxel_m
        ij = np.floor((uv - low) / search.voxel_m).astype(int)
        use = np.full(ij.max(axis=0) + 2, OUTSIDE, dtype=np.uint8)
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                use[ij[:, 0] + i, ij[:, 1] + j] = INSIDE
        patch = _Patch(plane_of(region.normal, region.centre), across, low, use)
        if region.bends(voxels) or region.continues(voxels, bent):
            bent[region.members] = True
            patch = patch.as_exclusion_zone()
        patches.append(patch)
    return patches


def _packed(patches: list[_Patch], edge_m: float) -> OccupancyGrid:
    """The patches as arrays for the kernels, those with most cells first."""
    patches = sorted(patches, key=lambda p: -p.n_inside)
    first = np.cumsum([0, *(p.use.size for p in patches)])[:-1].astype(np.int64)
    return OccupancyGrid(
        np.array([p.plane for p in patches]).reshape(-1, 6),
        np.array([p.axes for p in patches]).reshape(-1, 2, 3),
        np.array([p.low for p in patches]).reshape(-1, 2),
        np.array([p.use.shape for p in patches], dtype=np.int64).reshape(-1, 2),
        first,
        np.concatenate([np.zeros(0, dtype=np.uint8), *(p.use.ravel() for p in patches)]),
        edge_m,
    )


def _associate(
    cells: OccupancyGrid, points: np.ndarray, origins: np.ndarray, search: PlaneSearch
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plane (N,), cell (N,) and distance (N,) m of each point, see `associate`."""
    n = len(points)
    plane, cell, distance = np.empty(n, np.int32), np.empty(n, np.int64), np.empty(n)
    variances = search.noise_m**2 + search.position_m**2, search.angle_rad**2
    associate(points, origins, cells, variances, (search.gate, search.least_cosine), plane, cell, distance)
    return plane, cell, distance


def _associate_at_once(
    cells: OccupancyGrid, points: np.ndarray, origins: np.ndarray, search: PlaneSearch
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `_associate`, on two threads."""
    halves = (slice(0, len(points) // 2), slice(len(points) // 2, None))
    with ThreadPoolExecutor(len(halves)) as pool:
        parts = pool.map(lambda h: _associate(cells, points[h], origins[h], search), halves)
        plane, cell, distance = (np.concatenate(column) for column in zip(*parts, strict=True))
    return plane, cell, distance


def _refined(
    patches: list[_Patch],
    points: np.ndarray,
    origins: np.ndarray,
    variance: np.ndarray,
    search: PlaneSearch,
    last: bool,
) -> list[_Patch]:
    """Planes fitted again to their associated points, without cells that are empty or not flat. Planes that are too
    small lose their cells; in the `last` round, if the cloud is well registered, uneven ones do, too."""
    patches = sorted(patches, key=lambda p: -p.n_inside)
    cells = _packed(patches, search.voxel_m)
    plane, cell, distance = _associate_at_once(cells, points, origins, search)
    stats, moments = np.zeros((len(cells.use), 3)), np.zeros((len(patches), MOMENTS))
    sum_cells(points, variance, plane, cell, distance, stats, moments)
    good = (stats[:, 0] >= FEWEST_IN_VOXEL) & (stats[:, 2] < MIXED_CELL_RMS**2 * stats[:, 0])
    use = np.where(good, cells.use, np.minimum(cells.use, NEAR))
    mine = [slice(a, a + p.use.size) for a, p in zip(cells.first, patches, strict=True)]
    in_place = last and search.position_m <= FINE_M
    uneven = _uneven([stats[k][use[k] == INSIDE] for k in mine]) if in_place else np.zeros(len(mine), dtype=bool)
    refined = []
    for patch, cut, strays, sums in zip(patches, mine, uneven, moments, strict=True):
        use_of_patch = use[cut].reshape(patch.use.shape)
        if strays or (use_of_patch == INSIDE).sum() * search.voxel_m**2 < search.smallest_m2:
            refined.append(patch.as_exclusion_zone())
            continue
        normal, old, centre = patch.plane[:3].copy(), patch.plane[3:], np.empty(3)
        fit(sums, normal, centre)
        # The point moves only along the normal, so that the cells stay in place.
        at = old + normal * (normal @ (centre - old))
        refined.append(replace(patch, plane=np.append(normal, at), use=use_of_patch))
    return refined


def _uneven(stats: list[np.ndarray]) -> np.ndarray:
    """(P,) whether each plane is uneven, if most points lie on even ones; stats (C, 3) of the cells of each plane: see
    `sum_cells`. A surface may wave within the noise without a bend as a whole, but thousands of points show it."""
    strays = np.array([_unevenness(s) for s in stats])
    points, order = np.array([s[:, 0].sum() for s in stats]), np.argsort(strays)
    usual = strays[order[np.searchsorted(np.cumsum(points[order]), 0.5 * points.sum())]] if len(stats) else 0.0
    return strays > (UNEVEN_CELLS if usual < EVEN_CELLS else np.inf)


def _unevenness(stats: np.ndarray) -> float:
    """RMS over the points of the deviation of cell means (C, 3) from their plane, in standard deviations of a point.
    The part that noise causes is subtracted."""
    count, total, _ = stats.T
    return float(np.sqrt(max((total**2 / count).sum() - len(stats), 0.0) / count.sum())) if len(stats) else 0.0


MOMENTS = 10  # sums of 1; x, xx; y, yx, yy; z, zx, zy, zz
LARGEST_TURN = 0.26  # rad: largest angle between the normals of a voxel, which is inaccurate, and of its region
EXCLUSIVE_GATES = 1.6  # gates: least distance between a point and any other plane
SAME_SIDE = 0.5  # cosine between the normals of planes that face the same way
REGION_REACH = 2.5  # standard deviations: largest distance between a voxel's centre and the plane of its region


OUTSIDE, NEAR, INSIDE = 0, 1, 2  # use of a cell by its plane


class Voxels(NamedTuple):
    """moments (V, 10): about the world's origin; normal (V, 3): towards the sensor; centre (V, 3) m; sigma (V,) m:
    standard deviation of the points; neighbour (V, 26): indices, -1 for none; flat (V,): whether the voxel can belong
    to a region."""

    moments: np.ndarray
    normal: np.ndarray
    centre: np.ndarray
    sigma: np.ndarray
    neighbour: np.ndarray
    flat: np.ndarray


class OccupancyGrid(NamedTuple):
    """Cells of P planes (P, 6): normal and point. The cells of plane q are squares of edge edge_m on a grid along
    axes[q] (2, 3). The grid starts at low[q] (2,) m from the point and has size[q] (2,) cells.

    Entries of `use` from first[q] on: OUTSIDE the plane; NEAR, where the plane may be, so that no other plane gets the
    points; INSIDE, cells whose points belong to the plane.
    """

    planes: np.ndarray
    axes: np.ndarray
    low: np.ndarray
    size: np.ndarray
    first: np.ndarray
    use: np.ndarray
    edge_m: float


@njit(cache=True, nogil=True)
def sum_voxels(points, origins, variance, which, moments, towards, total):
    """Adds the moments of points (N, 3) to moments (V, 10), unit vectors to the sensor to towards (V, 3), and variances
    to total (V,). origins (N, 3): position of the sensor at each point; which (N,): voxel of each point."""
    for n in range(len(points)):
        v = which[n]
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        a, b, c = origins[n, 0] - x, origins[n, 1] - y, origins[n, 2] - z
        f = 1.0 / np.sqrt(a * a + b * b + c * c)
        towards[v, 0] += f * a
        towards[v, 1] += f * b
        towards[v, 2] += f * c
        total[v] += variance[n]
        row = (1.0, x, x * x, y, y * x, y * y, z, z * x, z * y, z * z)
        for k in range(MOMENTS):
            moments[v, k] += row[k]


@njit(cache=True, nogil=True)
def fit(moments, normal, centre):
    """Least-squares plane of moments (10,): fills centre and normal, which keeps its side. Returns the variance along
    the normal."""
    n = moments[0]
    for i, k in enumerate((1, 3, 6)):
        centre[i] = moments[k] / n
    x, y, z = centre
    S = np.empty((3, 3))
    S[0, 0], S[1, 1], S[2, 2] = moments[2] / n - x * x, moments[5] / n - y * y, moments[9] / n - z * z
    S[1, 0], S[2, 0], S[2, 1] = moments[4] / n - y * x, moments[7] / n - z * x, moments[8] / n - z * y
    S[0, 1], S[0, 2], S[1, 2] = S[1, 0], S[2, 0], S[2, 1]
    values, vectors = np.linalg.eigh(S)
    side = normal[0] * vectors[0, 0] + normal[1] * vectors[1, 0] + normal[2] * vectors[2, 0]
    for i in range(3):
        normal[i] = vectors[i, 0] if side >= 0.0 else -vectors[i, 0]
    return values[0]


@njit(cache=True, nogil=True)
def _fits(v, voxels, normal, centre):
    """Whether voxel v lies on the plane of a region, with its normal on the same side."""
    cosine, distance = 0.0, 0.0
    for i in range(3):
        cosine += normal[i] * voxels.normal[v, i]
        distance += normal[i] * (voxels.centre[v, i] - centre[i])
    return cosine > np.cos(LARGEST_TURN) and abs(distance) < REGION_REACH * voxels.sigma[v]


@njit(cache=True, nogil=True)
def grow(voxels, seeds, region):
    """Fills region (V,) with the region of each voxel, -1 for none, from `seeds` in their order; returns the number of
    regions."""
    count, queue = 0, np.empty(len(region), np.int64)
    total, normal, centre = np.empty(MOMENTS), np.empty(3), np.empty(3)
    for s in seeds:
        if region[s] >= 0 or not voxels.flat[s]:
            continue
        region[s], queue[0], size, done, refit = count, s, 1, 0, 2
        for i in range(MOMENTS):  # in loops: array expressions take seconds to compile
            total[i] = voxels.moments[s, i]
        for i in range(3):
            normal[i], centre[i] = voxels.normal[s, i], voxels.centre[s, i]
        while done < size:
            for v in voxels.neighbour[queue[done]]:
                if v < 0 or region[v] >= 0 or not voxels.flat[v] or not _fits(v, voxels, normal, centre):
                    continue
                region[v], queue[size] = count, v
                size += 1
                for i in range(MOMENTS):
                    total[i] += voxels.moments[v, i]
                if size >= refit:
                    fit(total, normal, centre)
                    refit = size + 1 + size // 8
            done += 1
        count += 1
    return count


@njit(cache=True, nogil=True)
def _reach(q, x, y, z, cells):
    """Cell of plane q that contains the point, -1 if it is outside of the plane's cells."""
    p, k = cells.planes[q], 0
    for i in range(2):
        a = cells.axes[q, i]
        u = a[0] * (x - p[3]) + a[1] * (y - p[4]) + a[2] * (z - p[5])
        c = int(np.floor((u - cells.low[q, i]) / cells.edge_m))
        if c < 0 or c >= cells.size[q, i]:
            return -1
        k = k * cells.size[q, i] + c
    return cells.first[q] + k if cells.use[cells.first[q] + k] != OUTSIDE else -1


@njit(cache=True, nogil=True)
def _fill_equations(planes, equation):
    """Fills equation (4, P): unit normals and distances [m] from the origin of planes (P, 6), normal and point. There
    is one row for each coefficient, so that loops over planes are vectorised."""
    for q in range(len(planes)):
        p = planes[q]
        equation[0, q], equation[1, q], equation[2, q] = p[0], p[1], p[2]
        equation[3, q] = p[0] * p[3] + p[1] * p[4] + p[2] * p[5]


@njit(cache=True, nogil=True)
def associate(points, origins, cells, variances, limits, plane, cell, distance):
    """Associates each point with the plane within a gate of standard deviations that faces the sensor. The plane is -1
    if there is none, or if a second plane is near, even one that the beam grazes (the floor at the foot of a far wall).
    Fills `plane`, `cell` and `distance` of each point. origins (N, 3) m: position of the sensor at each point.
    variances: of a point [m^2], and of its direction [rad^2]; limits: gate, and least cosine.

    The cell is that of the intersection of beam and plane. The measured point would bias the plane by 1.5 mm for small
    faces. Noise along the beam moves points across an edge, or towards another plane, more often in one direction than
    in the other.
    """
    count = len(cells.planes)
    equation, r = np.empty((4, count)), np.empty(count)
    _fill_equations(cells.planes, equation)
    # The loops over planes are not kernels of their own: calls with arrays for each point cost 30 % of the time.
    for n in range(len(points)):
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        a, b, c = origins[n, 0] - x, origins[n, 1] - y, origins[n, 2] - z
        far2 = a * a + b * b + c * c
        far = np.sqrt(far2)
        reach, least = limits[0] * np.sqrt(variances[0] + variances[1] * far2), limits[1] * far
        n_hits, q_hit, k_hit, s_hit = 0, -1, -1, 0.0
        for q in range(count):
            r[q] = equation[0, q] * x + equation[1, q] * y + equation[2, q] * z - equation[3, q]
        for q in range(count):
            if abs(r[q]) > reach:
                continue
            facing = equation[0, q] * a + equation[1, q] * b + equation[2, q] * c
            if facing < least:
                continue
            s = -r[q] / facing
            k = _reach(q, x + s * a, y + s * b, z + s * c, cells)
            if k >= 0:
                n_hits += 1
                q_hit, k_hit, s_hit = q, k, s
        plane[n] = -1
        if n_hits == 1 and cells.use[k_hit] == INSIDE:
            foot = x + s_hit * a, y + s_hit * b, z + s_hit * c
            near, longest = EXCLUSIVE_GATES * reach, EXCLUSIVE_GATES * reach + abs(s_hit) * far
            for q in range(count):
                if abs(r[q]) > longest or q == q_hit:
                    continue
                facing = equation[0, q] * a + equation[1, q] * b + equation[2, q] * c
                if facing > 0.0 and abs(r[q] + s_hit * facing) <= near and _reach(q, *foot, cells) >= 0:
                    break
            else:
                plane[n], cell[n], distance[n] = q_hit, k_hit, r[q_hit]


@njit(cache=True, nogil=True)
def seen_through(points, origins, plane, reach, cells):
    """Number of points whose beam passed through another plane that faces the sensor and is alike (SAME_SIDE), more
    than `reach` [m] in front of their own. Surfaces are opaque: one that drift has doubled is seen through the other.

    points, origins (N, 3) m: as in `associate`; plane (N,): of each point, -1 for none.
    """
    count = 0
    for n in range(len(points)):
        if plane[n] < 0:
            continue
        its_plane = cells.planes[plane[n]]
        for q in range(len(cells.planes)):
            p = cells.planes[q]
            if q == plane[n] or its_plane[0] * p[0] + its_plane[1] * p[1] + its_plane[2] * p[2] < SAME_SIDE:
                continue
            before, behind = 0.0, 0.0
            for i in range(3):
                before += p[i] * (origins[n, i] - p[3 + i])
                behind -= p[i] * (points[n, i] - p[3 + i])
            if before <= 0.0 or behind <= reach:
                continue
            s = before / (before + behind)
            x = origins[n, 0] + s * (points[n, 0] - origins[n, 0])
            y = origins[n, 1] + s * (points[n, 1] - origins[n, 1])
            z = origins[n, 2] + s * (points[n, 2] - origins[n, 2])
            k = _reach(q, x, y, z, cells)
            if k >= 0 and cells.use[k] == INSIDE:
                count += 1
                break
    return count


@njit(cache=True, nogil=True)
def sum_cells(points, variance, plane, cell, distance, stats, moments):
    """Adds to stats (C, 3) number, sum and sum of squares of the whitened distances in each cell; and to moments (P,
    10) the moments of each plane's points, weighted by the inverse variance."""
    for n in range(len(points)):
        q = plane[n]
        if q < 0:
            continue
        r = distance[n] / np.sqrt(variance[n])
        stats[cell[n], 0] += 1.0
        stats[cell[n], 1] += r
        stats[cell[n], 2] += r * r
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        row = (1.0, x, x * x, y, y * x, y * y, z, z * x, z * y, z * z)
        for k in range(MOMENTS):
            moments[q, k] += row[k] / variance[n]


MIN_DIRECTION_SHARE = 0.02  # of the points: 0.2 and more for a direction that walls face, 0.002 and less by noise


def count_directions(shares: np.ndarray) -> int:
    """Number of independent directions that surfaces face, 0 to 3. shares (3,): see `normal_shares`."""
    return int((shares > MIN_DIRECTION_SHARE).sum())


def normal_shares(normal: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Shares (3,) of the total weight along the principal axes of normals, increasing: eigenvalues of the weighted mean
    of n n^T. normal (n, 3); weight (n,)."""
    return np.linalg.eigvalsh((normal * weight[:, None]).T @ normal / weight.sum())
