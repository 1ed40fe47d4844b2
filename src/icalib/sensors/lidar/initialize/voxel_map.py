"""Compiled parts of LiDAR odometry: a map of flat voxels, and a scan's distances from it.

A point x at tau seconds from its scan's middle is seen at y = R Exp(w tau) x + p + v tau in the map: the scan's pose
(R, p) and its twist, w in its own axes and v in the map's. Its distance from the plane of the voxel that y falls into
moves by

    dr = n . (-R [z]x dtheta + dp - R [z]x tau dw + tau dv)     z = Exp(w tau) x

where Exp((w + dw) tau) = Exp(w tau) Exp(tau dw) is good enough within a scan.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.small import eigen3, mul3

UNKNOWNS = 12  # of a scan: turn, position, rate, velocity
PRODUCTS = 27  # of a point: upper triangle of its derivatives by the pose with one another, and with its distance
MOMENTS = 9  # x; y; z; xx; yx, yy; zx, zy, zz about the voxel's middle
FEWEST = 6  # points of a voxel
ACROSS = 0.06  # of a voxel's edge: what spreads less in its own plane is a line
FLATTEST = 0.15  # of a voxel's edge: what spreads more across is no plane
NEAR = 0.2  # of a voxel's edge
REACH = 1 << 20  # voxels from the origin to either side


class VoxelMap(NamedTuple):
    """An open hash table of cubic voxels with edge `edge_m`. key (H,): -1 where empty; place (H,): row of the voxel.
    size (1,): number of voxels in use.

    Per voxel: middle (V, 3) of the cube [m]; weight (V,): decayed number of points; moments (V, 9) about middle, see
    MOMENTS; touched (V,): last scan that added a point; centre, normal (V, 3) of the points; flat (V,): they are a
    plane."""

    edge_m: float
    key: np.ndarray
    place: np.ndarray
    size: np.ndarray
    middle: np.ndarray
    weight: np.ndarray
    moments: np.ndarray
    touched: np.ndarray
    centre: np.ndarray
    normal: np.ndarray
    flat: np.ndarray

    @classmethod
    def empty(cls, edge_m: float, capacity: int) -> VoxelMap:
        """Room for `capacity` voxels, a power of two; points of further ones are not kept."""
        n = capacity
        return cls(
            edge_m,
            np.full(2 * n, -1, np.int64),
            np.zeros(2 * n, np.int64),
            np.zeros(1, np.int64),
            np.zeros((n, 3)),
            np.zeros(n),
            np.zeros((n, MOMENTS)),
            np.zeros(n, np.int64),
            np.zeros((n, 3)),
            np.zeros((n, 3)),
            np.zeros(n, np.bool_),
        )

    def clear(self) -> None:
        """As if nothing had been put in."""
        self.key[:], self.size[:], self.weight[:], self.moments[:], self.flat[:] = -1, 0, 0.0, 0.0, False


class ScanPose(NamedTuple):
    """Of a scan's middle, in the map: R (3, 3), p (3,) m; rate (3,) rad/s in its own axes, velocity (3,) m/s."""

    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray


@njit(cache=True, nogil=True)
def _index(x, voxels):
    return int(np.floor(x / voxels.edge_m))


@njit(cache=True, nogil=True)
def _slot(key, i, j, k):
    """Where voxel (i, j, k) is in the hash table, or would be; and its key. Voxels above one another are neighbours
    there, too: searches look at these together."""
    column = ((i + REACH) << 21) + (j + REACH)
    own, mask = (column << 21) + (k + REACH), len(key) - 1
    s = (((column * 0x9E3779B97F4A7C1) >> 20) + k) & mask
    while key[s] != own and key[s] != -1:
        s = (s + 1) & mask
    return s, own


@njit(cache=True, nogil=True)
def place_point(pose, x, y, z, tau, out):
    """out (6,): the point in the map, then z = Exp(w tau) x."""
    w = pose.rate
    a, b, c = w[0] * tau, w[1] * tau, w[2] * tau
    # Exp to second order: a scan turns by less than half a radian to either side.
    ux, uy, uz = b * z - c * y, c * x - a * z, a * y - b * x
    out[3] = x + ux + 0.5 * (b * uz - c * uy)
    out[4] = y + uy + 0.5 * (c * ux - a * uz)
    out[5] = z + uz + 0.5 * (a * uy - b * ux)
    R, p, v = pose.rotation, pose.position, pose.velocity
    for i in range(3):
        out[i] = R[i, 0] * out[3] + R[i, 1] * out[4] + R[i, 2] * out[5] + p[i] + v[i] * tau


@njit(cache=True, nogil=True)
def insert(voxels, pose, xyz, tau, scan, keep):
    """Adds points xyz (n, 3) of scan number `scan`; older content decays by the factor `keep` per scan."""
    y, touched, n_touched = np.empty(6), np.empty(len(xyz), np.int64), 0
    for n in range(len(xyz)):
        place_point(pose, xyz[n, 0], xyz[n, 1], xyz[n, 2], tau[n], y)
        i, j, k = _index(y[0], voxels), _index(y[1], voxels), _index(y[2], voxels)
        if max(abs(i), abs(j), abs(k)) >= REACH - 1:
            continue
        s, own = _slot(voxels.key, i, j, k)
        if voxels.key[s] == -1:
            if voxels.size[0] == len(voxels.weight):
                continue
            voxels.key[s], voxels.place[s] = own, voxels.size[0]
            v = voxels.size[0]
            voxels.size[0] += 1
            for a, index in enumerate((i, j, k)):
                voxels.middle[v, a] = (index + 0.5) * voxels.edge_m
            voxels.touched[v] = -1
        v = voxels.place[s]
        if voxels.touched[v] != scan:
            f = keep ** (scan - voxels.touched[v])
            voxels.weight[v] *= f
            for a in range(MOMENTS):
                voxels.moments[v, a] *= f
            voxels.touched[v] = scan
            touched[n_touched] = v
            n_touched += 1
        voxels.weight[v] += 1.0
        a, b, c = y[0] - voxels.middle[v, 0], y[1] - voxels.middle[v, 1], y[2] - voxels.middle[v, 2]
        row = (a, b, c, a * a, b * a, b * b, c * a, c * b, c * c)
        for m in range(MOMENTS):
            voxels.moments[v, m] += row[m]
    for i in range(n_touched):
        _fit(voxels, touched[i])


@njit(cache=True, nogil=True)
def _fit(voxels, v):
    """Centre, normal and flatness of a voxel from its moments."""
    m, w = voxels.moments[v], voxels.weight[v]
    a, b, c = m[0] / w, m[1] / w, m[2] / w
    S, spread, axes = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    S[0, 0], S[1, 1], S[2, 2] = m[3] / w - a * a, m[5] / w - b * b, m[8] / w - c * c
    S[1, 0], S[2, 0], S[2, 1] = m[4] / w - b * a, m[6] / w - c * a, m[7] / w - c * b
    S[0, 1], S[0, 2], S[1, 2] = S[1, 0], S[2, 0], S[2, 1]
    eigen3(S, spread, axes)
    edge2 = voxels.edge_m * voxels.edge_m
    thin = spread[0] < FLATTEST * FLATTEST * edge2 and spread[0] < 0.25 * spread[1]
    voxels.flat[v] = w >= FEWEST and thin and spread[1] > ACROSS * ACROSS * edge2
    for i, x in enumerate((a, b, c)):
        voxels.centre[v, i] = voxels.middle[v, i] + x
        voxels.normal[v, i] = axes[i, 0]


@njit(cache=True, nogil=True, inline="always")
def _voxel_at(voxels, y, around):
    """The flat voxel that y falls into, or with `around` of the 27 there the one with the nearest centre; -1: none."""
    i0, j0, k0 = _index(y[0], voxels), _index(y[1], voxels), _index(y[2], voxels)
    if max(abs(i0), abs(j0), abs(k0)) >= REACH - 2:
        return -1
    found, least = -1, np.inf
    for i in range(i0 - around, i0 + around + 1):
        for j in range(j0 - around, j0 + around + 1):
            for k in range(k0 - around, k0 + around + 1):
                s, _ = _slot(voxels.key, i, j, k)
                v = voxels.place[s]
                if voxels.key[s] == -1 or not voxels.flat[v]:
                    continue
                d = 0.0
                for a in range(3):
                    d += (y[a] - voxels.centre[v, a]) ** 2
                if d < least:
                    found, least = v, d
    return found


@njit(cache=True, nogil=True, inline="always")
def _derivatives(R, normal, y, J):
    """J (6,) of a distance by turn and position; n . (-R [z]x d) = d . (z x R^T n)."""
    b0 = R[0, 0] * normal[0] + R[1, 0] * normal[1] + R[2, 0] * normal[2]
    b1 = R[0, 1] * normal[0] + R[1, 1] * normal[1] + R[2, 1] * normal[2]
    b2 = R[0, 2] * normal[0] + R[1, 2] * normal[1] + R[2, 2] * normal[2]
    J[0], J[1], J[2] = y[4] * b2 - y[5] * b1, y[5] * b0 - y[3] * b2, y[3] * b1 - y[4] * b0
    for a in range(3):
        J[3 + a] = normal[a]


@njit(cache=True, nogil=True, inline="always")
def _add_products(product, tau, by_0, by_1, by_2):
    """A loop that the compiler makes a few instructions of."""
    for k in range(PRODUCTS):
        by_0[k] += product[k]
        by_1[k] += tau * product[k]
        by_2[k] += tau * tau * product[k]


@njit(cache=True, nogil=True)
def sums(voxels, pose, xyz, tau, around, scale, H, g):
    """Fills the normal equations H (12, 12), g (12,) of the scan's distances [m] from the map, Geman and McClure's
    weights of `scale` m. Returns how many points met a plane, and how many of these are near it."""
    y, J, met, near = np.empty(6), np.empty(7), 0, 0
    # Derivatives by rates are tau times those by the pose: sums of (J, r) J by 1, tau and tau^2, upper triangles.
    product, by_0, by_1, by_2 = np.empty(PRODUCTS), np.zeros(PRODUCTS), np.zeros(PRODUCTS), np.zeros(PRODUCTS)
    for n in range(len(xyz)):
        place_point(pose, xyz[n, 0], xyz[n, 1], xyz[n, 2], tau[n], y)
        v = _voxel_at(voxels, y, around)
        if v < 0:
            continue
        normal, r = voxels.normal[v], 0.0
        for a in range(3):
            r += normal[a] * (y[a] - voxels.centre[v, a])
        met += 1
        near += abs(r) < NEAR * voxels.edge_m
        root = 1.0 + (r / scale) ** 2
        _derivatives(pose.rotation, normal, y, J)
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
    return met, near


@njit(cache=True, nogil=True)
def pick(xyz, offset, chosen, middle, nearest, points, tau):
    """Fills points (n, 3) and tau (n,), offsets from `middle`, with those of `chosen` (n,) that are somewhere, and
    further than `nearest`; returns how many."""
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
def turn_back(xyz, which, turns):
    """Points xyz (n, 3) turned by turns[which] each, in place."""
    for n in range(len(xyz)):
        R, x, y, z = turns[which[n]], xyz[n, 0], xyz[n, 1], xyz[n, 2]
        for a in range(3):
            xyz[n, a] = R[a, 0] * x + R[a, 1] * y + R[a, 2] * z


@njit(cache=True, nogil=True)
def moved(pose, d):
    """The pose corrected by d (12,)."""
    position, rate, velocity = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        position[i], rate[i] = pose.position[i] + d[3 + i], pose.rate[i] + d[6 + i]
        velocity[i] = pose.velocity[i] + d[9 + i]
    return ScanPose(mul3(pose.rotation, so3.exp(d[:3])), position, rate, velocity)
