"""Compiled map of planar voxels for LiDAR odometry, and point-to-plane distances of a scan from the map.

A point x, measured tau seconds after the middle of its scan, is at y = R Exp(w tau) x + p + v tau in the map. The pose
(R, p) is that of the middle, w is the angular rate in axes of the LiDAR, and v the velocity in axes of the map. The
distance r from the plane of the voxel at y has the differential

    dr = n . (-R [z]x dtheta + dp - R [z]x tau dw + tau dv)     z = Exp(w tau) x

with the approximation Exp((w + dw) tau) = Exp(w tau) Exp(tau dw).

Geometric degeneracy of a scene: whether the flat surfaces that a LiDAR sees face fewer than three directions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.data.measurements import LidarStream, Measurements
from icalib.detection.planes import count_directions, normal_shares
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.small import eigen3, mul3

N_SCAN_UNKNOWNS = 12  # rotation, position, angular rate, velocity
N_PRODUCTS = 27  # per point: upper triangle of the products of its 6 pose derivatives and its distance r, without r^2
N_VOXEL_MOMENTS = 9  # sums of x; y; z; xx; yx, yy; zx, zy, zz about the centre of the cube
MIN_VOXEL_POINTS = 6  # least weight of a planar voxel; a plane has 3 unknowns
# Standard deviations of the points of a planar voxel, as shares of its edge (a uniformly filled one has 0.29):
MIN_PLANE_WIDTH = 0.06  # along the narrower direction in the plane; narrower points form a line
MAX_PLANE_THICKNESS = 0.15  # along the normal
NEAR_PLANE = 0.2  # share of the edge; a point nearer to a plane of the map counts as near
MAX_VOXEL_INDEX = 1 << 20  # limit of the voxel index along an axis, so that three indices fit 64 bits


class VoxelMap(NamedTuple):
    """A hash table of cubic voxels with edge `edge_m`, by linear probing. key (H,): key of the voxel in each slot, -1
    if empty; row (H,): row of this voxel in the arrays below; size (1,): number of voxels in use.

    For each voxel: middle (V, 3): centre of the cube [m]; weight (V,): decayed number of points; moments (V, 9):
    decayed moments about middle, see N_VOXEL_MOMENTS; last_scan (V,): number of the last scan that added a point;
    centre (V, 3) [m], normal (V, 3): mean and plane normal of the points; flat (V,) bool: the points are planar.
    """

    edge_m: float
    key: np.ndarray
    row: np.ndarray
    size: np.ndarray
    middle: np.ndarray
    weight: np.ndarray
    moments: np.ndarray
    last_scan: np.ndarray
    centre: np.ndarray
    normal: np.ndarray
    flat: np.ndarray

    @classmethod
    def empty(cls, edge_m: float, capacity: int) -> VoxelMap:
        """A map of at most `capacity` voxels, a power of two. Points in further voxels are ignored."""
        n = capacity
        return cls(
            edge_m,
            np.full(2 * n, -1, np.int64),
            np.zeros(2 * n, np.int64),
            np.zeros(1, np.int64),
            np.zeros((n, 3)),
            np.zeros(n),
            np.zeros((n, N_VOXEL_MOMENTS)),
            np.zeros(n, np.int64),
            np.zeros((n, 3)),
            np.zeros((n, 3)),
            np.zeros(n, np.bool_),
        )

    def clear(self) -> None:
        """Removes all points."""
        self.key[:], self.size[:], self.weight[:], self.moments[:], self.flat[:] = -1, 0, 0.0, 0.0, False


class ScanPose(NamedTuple):
    """Pose and twist of the LiDAR at the middle of a scan: R_map_lidar (3, 3), p_map_lidar (3,) [m], angular rate (3,)
    [rad/s] in axes of the LiDAR, velocity (3,) [m/s] in axes of the map."""

    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray


@njit(cache=True, nogil=True)
def _index(x, voxels):
    """Index of the voxel along one axis at coordinate x [m]."""
    return int(np.floor(x / voxels.edge_m))


@njit(cache=True, nogil=True)
def _slot(key, i, j, k):
    """Slot of voxel (i, j, k) in the hash table, or the empty slot for it; and its key. Voxels that differ in k only
    are neighbours in the table, as searches visit them together."""
    column = ((i + MAX_VOXEL_INDEX) << 21) + (j + MAX_VOXEL_INDEX)
    voxel_key, mask = (column << 21) + (k + MAX_VOXEL_INDEX), len(key) - 1
    s = (((column * 0x9E3779B97F4A7C1) >> 20) + k) & mask
    while key[s] != voxel_key and key[s] != -1:
        s = (s + 1) & mask
    return s, voxel_key


@njit(cache=True, nogil=True)
def place_point(pose, x, y, z, tau, out):
    """Fills out (6,): the point (x, y, z) in the map [m], then Exp(w tau) (x, y, z)."""
    w = pose.rate
    a, b, c = w[0] * tau, w[1] * tau, w[2] * tau
    # Exp to second order: a scan turns by less than 0.5 rad to either side of its middle.
    ux, uy, uz = b * z - c * y, c * x - a * z, a * y - b * x
    out[3] = x + ux + 0.5 * (b * uz - c * uy)
    out[4] = y + uy + 0.5 * (c * ux - a * uz)
    out[5] = z + uz + 0.5 * (a * uy - b * ux)
    R, p, v = pose.rotation, pose.position, pose.velocity
    for i in range(3):
        out[i] = R[i, 0] * out[3] + R[i, 1] * out[4] + R[i, 2] * out[5] + p[i] + v[i] * tau


@njit(cache=True, nogil=True)
def insert(voxels, pose, xyz, tau, scan, decay):
    """Adds points xyz (n, 3) [m], at tau (n,) [s] from the middle of scan number `scan`, with the LiDAR at `pose`. The
    weights of older points decay by the factor `decay` per scan."""
    y, touched, n_touched = np.empty(6), np.empty(len(xyz), np.int64), 0
    for n in range(len(xyz)):
        place_point(pose, xyz[n, 0], xyz[n, 1], xyz[n, 2], tau[n], y)
        i, j, k = _index(y[0], voxels), _index(y[1], voxels), _index(y[2], voxels)
        if max(abs(i), abs(j), abs(k)) >= MAX_VOXEL_INDEX - 1:
            continue
        s, voxel_key = _slot(voxels.key, i, j, k)
        if voxels.key[s] == -1:
            if voxels.size[0] == len(voxels.weight):
                continue
            voxels.key[s], voxels.row[s] = voxel_key, voxels.size[0]
            v = voxels.size[0]
            voxels.size[0] += 1
            for a, index in enumerate((i, j, k)):
                voxels.middle[v, a] = (index + 0.5) * voxels.edge_m
            voxels.last_scan[v] = -1
        v = voxels.row[s]
        if voxels.last_scan[v] != scan:
            f = decay ** (scan - voxels.last_scan[v])
            voxels.weight[v] *= f
            for a in range(N_VOXEL_MOMENTS):
                voxels.moments[v, a] *= f
            voxels.last_scan[v] = scan
            touched[n_touched] = v
            n_touched += 1
        voxels.weight[v] += 1.0
        a, b, c = y[0] - voxels.middle[v, 0], y[1] - voxels.middle[v, 1], y[2] - voxels.middle[v, 2]
        row = (a, b, c, a * a, b * a, b * b, c * a, c * b, c * c)
        for m in range(N_VOXEL_MOMENTS):
            voxels.moments[v, m] += row[m]
    for i in range(n_touched):
        _fit_plane(voxels, touched[i])


@njit(cache=True, nogil=True)
def _fit_plane(voxels, v):
    """Updates centre, normal and flatness of voxel v from its moments (principal axes)."""
    m, w = voxels.moments[v], voxels.weight[v]
    a, b, c = m[0] / w, m[1] / w, m[2] / w
    S, spread, axes = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    S[0, 0], S[1, 1], S[2, 2] = m[3] / w - a * a, m[5] / w - b * b, m[8] / w - c * c
    S[1, 0], S[2, 0], S[2, 1] = m[4] / w - b * a, m[6] / w - c * a, m[7] / w - c * b
    S[0, 1], S[0, 2], S[1, 2] = S[1, 0], S[2, 0], S[2, 1]
    eigen3(S, spread, axes)
    edge2 = voxels.edge_m * voxels.edge_m
    thin = spread[0] < MAX_PLANE_THICKNESS * MAX_PLANE_THICKNESS * edge2 and spread[0] < 0.25 * spread[1]
    voxels.flat[v] = w >= MIN_VOXEL_POINTS and thin and spread[1] > MIN_PLANE_WIDTH * MIN_PLANE_WIDTH * edge2
    for i, x in enumerate((a, b, c)):
        voxels.centre[v, i] = voxels.middle[v, i] + x
        voxels.normal[v, i] = axes[i, 0]


@njit(cache=True, nogil=True, inline="always")
def _planar_voxel_at(voxels, y, around):
    """Row of the planar voxel that contains y. With around = 1: of the planar voxel with the nearest centre among this
    voxel and its 26 neighbours. -1: none."""
    i0, j0, k0 = _index(y[0], voxels), _index(y[1], voxels), _index(y[2], voxels)
    if max(abs(i0), abs(j0), abs(k0)) >= MAX_VOXEL_INDEX - 2:
        return -1
    nearest, least = -1, np.inf
    for i in range(i0 - around, i0 + around + 1):
        for j in range(j0 - around, j0 + around + 1):
            for k in range(k0 - around, k0 + around + 1):
                s, _ = _slot(voxels.key, i, j, k)
                v = voxels.row[s]
                if voxels.key[s] == -1 or not voxels.flat[v]:
                    continue
                d = 0.0
                for a in range(3):
                    d += (y[a] - voxels.centre[v, a]) ** 2
                if d < least:
                    nearest, least = v, d
    return nearest


@njit(cache=True, nogil=True, inline="always")
def _fill_jacobian(R, normal, y, J):
    """Fills the first 6 entries of J: derivatives of a distance by rotation and position. n . (-R [z]x d) = d . (z x
    R^T n) with z = y[3:]."""
    b0 = R[0, 0] * normal[0] + R[1, 0] * normal[1] + R[2, 0] * normal[2]
    b1 = R[0, 1] * normal[0] + R[1, 1] * normal[1] + R[2, 1] * normal[2]
    b2 = R[0, 2] * normal[0] + R[1, 2] * normal[1] + R[2, 2] * normal[2]
    J[0], J[1], J[2] = y[4] * b2 - y[5] * b1, y[5] * b0 - y[3] * b2, y[3] * b1 - y[4] * b0
    for a in range(3):
        J[3 + a] = normal[a]


@njit(cache=True, nogil=True, inline="always")
def _add_products(product, tau, by_0, by_1, by_2):
    """Adds the products of a point times 1, tau and tau^2 to three sums. A separate loop, so that it is vectorised."""
    for k in range(N_PRODUCTS):
        by_0[k] += product[k]
        by_1[k] += tau * product[k]
        by_2[k] += tau * tau * product[k]


@njit(cache=True, nogil=True)
def accumulate_scan(voxels, pose, xyz, tau, around, scale, H, g):
    """Fills the normal equations H (12, 12), g (12,) of the distances [m] of points xyz (n, 3) from the map, with the
    weights of Geman and McClure. around: see `_planar_voxel_at`. Returns the numbers of points with a plane, and of
    those near their plane."""
    y, J, matched, near = np.empty(6), np.empty(7), 0, 0
    # Derivatives by rates are tau times those by the pose, so that sums of products times 1, tau and tau^2 are enough.
    product, by_0, by_1, by_2 = np.empty(N_PRODUCTS), np.zeros(N_PRODUCTS), np.zeros(N_PRODUCTS), np.zeros(N_PRODUCTS)
    for n in range(len(xyz)):
        place_point(pose, xyz[n, 0], xyz[n, 1], xyz[n, 2], tau[n], y)
        v = _planar_voxel_at(voxels, y, around)
        if v < 0:
            continue
        normal, r = voxels.normal[v], 0.0
        for a in range(3):
            r += normal[a] * (y[a] - voxels.centre[v, a])
        matched += 1
        near += abs(r) < NEAR_PLANE * voxels.edge_m
        root = 1.0 + (r / scale) ** 2
        _fill_jacobian(pose.rotation, normal, y, J)
        J[6] = r
        k = 0
        for a in range(6):
            w = J[a] / (root * root)
            for b in range(a, 7):
                product[k] = w * J[b]
                k += 1
        _add_products(product, tau[n], by_0, by_1, by_2)
    k = 0
    for a in range(6):
        for b in range(a, 6):
            for i, j in ((a, b), (b, a)):
                H[i, j], H[6 + i, j], H[i, 6 + j], H[6 + i, 6 + j] = by_0[k], by_1[k], by_1[k], by_2[k]
            k += 1
        g[a], g[6 + a] = by_0[k], by_1[k]
        k += 1
    return matched, near


@njit(cache=True, nogil=True)
def pick_points(xyz, offset, chosen, middle, nearest, points, tau):
    """Fills points (n, 3) [m] and tau (n,), their times since `middle` [s]. Points with indices `chosen` (n,) that are
    not finite, or not further away than `nearest` [m], are skipped. Returns the number of points filled."""
    count = 0
    for i in chosen:
        x, y, z = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        size2 = x * x + y * y + z * z
        if np.isfinite(size2) and size2 > nearest * nearest:
            points[count, 0], points[count, 1], points[count, 2] = x, y, z
            tau[count] = np.float64(offset[i]) - middle
            count += 1
    return count


@njit(cache=True, nogil=True)
def rotate_points(xyz, which, rotations):
    """Rotates points xyz (n, 3) in place; point n is rotated by rotations[which[n]]."""
    for n in range(len(xyz)):
        R, x, y, z = rotations[which[n]], xyz[n, 0], xyz[n, 1], xyz[n, 2]
        for a in range(3):
            xyz[n, a] = R[a, 0] * x + R[a, 1] * y + R[a, 2] * z


@njit(cache=True, nogil=True)
def corrected_pose(pose, d):
    """The pose and twist corrected by d (12,): rotation, position, angular rate, velocity."""
    position, rate, velocity = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        position[i], rate[i] = pose.position[i] + d[3 + i], pose.rate[i] + d[6 + i]
        velocity[i] = pose.velocity[i] + d[9 + i]
    return ScanPose(mul3(pose.rotation, so3.exp(d[:3])), position, rate, velocity)


N_SAMPLED_SCANS = 20  # of a recording, evenly spread: enough for a median
MAX_SAMPLED_POINTS = 6000  # of a scan
NORMAL_VOXEL_M = 1.0  # edge of the voxels whose normals are counted
MAX_NORMAL_VOXELS = 1 << 13
MIN_PLANAR_SCANS = 5  # scans with planar voxels, for a verdict
CLEARLY_MORE = 4.0  # ratio of shares: the position along the rarest normal is twice as accurate
DEGENERACIES = {
    1: "face one direction only, such as a floor or parallel walls, so the motion along them is unobservable",
    2: "face two directions only, as in a corridor, so the motion along both is unobservable",
}


@contextmanager
def explaining_degeneracy(streams: Sequence[LidarStream]) -> Iterator[None]:
    """Context that replaces an EstimationError by `degeneracy_error`."""
    try:
        yield
    except EstimationError as error:
        if (reason := degeneracy_error(streams)) is not None:
            raise reason from error
        raise


def degeneracy_error(streams: Sequence[LidarStream]) -> EstimationError | None:
    """An error, not raised, that names the degenerate scene, if a LiDAR saw such a scene; else None."""
    for stream in streams:
        if (n := n_directions(stream)) in DEGENERACIES:
            return EstimationError(
                f"the flat surfaces that {stream.name} sees {DEGENERACIES[n]}; record where walls and floor "
                "face three directions, or together with a camera that sees a target."
            )
    return None


def n_directions(stream: LidarStream) -> int:
    """Number of directions, 1 to 3, that flat surfaces face in most scans; 0 if few scans have flat surfaces."""
    shares = direction_shares(stream)
    return 0 if shares is None else count_directions(shares)


def direction_shares(stream: LidarStream) -> np.ndarray | None:
    """Median over scans of `normal_shares` (3,), increasing; None if few scans have flat surfaces."""
    filled = np.flatnonzero(np.diff(stream.start) > 0)
    some = filled[np.linspace(0, len(filled) - 1, min(N_SAMPLED_SCANS, len(filled))).astype(np.int64)]
    shares = [s for i in some if (s := _scan_shares(stream, int(i))) is not None]
    return np.median(shares, axis=0) if len(shares) >= MIN_PLANAR_SCANS else None


def leading(recordings: Sequence[Measurements]) -> int:
    """Index of the LiDAR whose odometry is determined best: the first, unless surfaces of another one face their rarest
    direction CLEARLY_MORE times as often in the recording that shows it least."""
    if len(recordings[0].lidars) == 1:
        return 0
    shares = [[direction_shares(stream) for stream in m.lidars] for m in recordings]
    least = np.min([[0.0 if s is None else s[0] for s in row] for row in shares], axis=0)
    best = int(np.argmax(least))
    return best if least[best] > CLEARLY_MORE * least[0] else 0


def _scan_shares(stream: LidarStream, scan: int) -> np.ndarray | None:
    """`normal_shares` (3,) of a scan, weighted by points; None if no voxel is planar."""
    xyz = stream.xyz[stream.start[scan] : stream.start[scan + 1]].astype(np.float64)
    size2 = (xyz**2).sum(axis=1)
    xyz = xyz[np.isfinite(size2) & (size2 > 0.0)]
    xyz = xyz[:: -(-len(xyz) // MAX_SAMPLED_POINTS) | 1]
    voxels = VoxelMap.empty(NORMAL_VOXEL_M, MAX_NORMAL_VOXELS)
    identity = ScanPose(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    insert(voxels, identity, xyz, np.zeros(len(xyz)), 0, 1.0)
    normal, weight = voxels.normal[voxels.flat], voxels.weight[voxels.flat]
    return normal_shares(normal, weight) if len(normal) else None
