"""Points of tracks on planes of the LiDARs. They constrain cameras against LiDARs where the motion does not.

A point P on the plane with normal n through q gives one row, with standard deviation `points_on_planes_m`:

    residual = n . (P - q)

Errors by relief of a surface do not average out over observations, nor over nearby points. So all points of one patch
of a plane together have the weight of one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.planes import tangents
from icalib.geometry.small import solve_definite
from icalib.optim.arrowhead import Piece
from icalib.optim.front_plan import FeatureSums
from icalib.optim.planes import Planes
from icalib.optim.robust_weights import Loss, weight
from icalib.optim.state import Key
from icalib.sensors.camera.features.point_search import PointSearch

ON_PLANES = "points on planes"  # kind of these residuals
CELL_M = 0.25  # a plane ends where no LiDAR saw it, to a cell; smaller ones have gaps between the lines of few lasers
PATCH_M = 1.0  # side of a patch, within which relief is much the same
MAX_OFF_STD = 3.0  # standard deviations that a point on a plane may be off
MAX_PLANE_DISTANCE_M = 0.5  # to points that may lie on a plane: so far cameras and LiDARs may be apart at first
MAX_ACROSS_SIGMA_M = 0.1  # standard deviation across a plane, above which a point lies on none
# Points that must agree on how far off a plane they are, and their least share of those that may lie on it.
MIN_POINTS_ON_PLANE, MIN_SHARE_ON_PLANE = 20, 0.4
MIN_COARSE_NOISE_M = 0.05  # least noise in early passes, whose poses are rough
MAX_CELLS = 1 << 20  # from the origin of a plane to its end; bounds the codes of cells


class OnPlanes(NamedTuple):
    """Planes of T tracks: plane (T,) index, -1 on none; sigma (T,) m: standard deviation of the row; weight (T,): one
    over the number of points on the patch."""

    plane: np.ndarray
    sigma: np.ndarray
    weight: np.ndarray

    @classmethod
    def none(cls, n: int) -> OnPlanes:
        return cls(np.full(n, -1), np.ones(n), np.ones(n))

    def of(self, tracks: slice) -> OnPlanes:
        return OnPlanes(*(a[tracks] for a in self))


NO_PLANES = OnPlanes.none(0)


class PlaneDistances(NamedTuple):
    """Distances of T points from their planes: residual (T,) m; root (T,) 1/m, square root of the robust weight over
    sigma, 0 on no plane; share (T,): how many of the point's three degrees of freedom this row determines."""

    residual: np.ndarray
    root: np.ndarray
    share: np.ndarray

    @classmethod
    def zeros(cls, n: int) -> PlaneDistances:
        return cls(np.zeros(n), np.zeros(n), np.zeros(n))

    def of(self, tracks: slice) -> PlaneDistances:
        return PlaneDistances(*(a[tracks] for a in self))


@dataclass(frozen=True)
class Surfaces:
    """The P planes of a pass, and where LiDARs observe them.

    keys: of their values in a state; plane (P, 6): normal, and point [m], at the start of the pass; recording (P,):
    index of the recording of each; cells: sorted codes of the observed cells, see `_codes`; noise [m]: standard
    deviation of points on them."""

    keys: tuple[Key, ...]
    plane: np.ndarray
    recording: np.ndarray
    cells: np.ndarray
    noise: float

    @classmethod
    def seen(
        cls,
        keys: tuple[Key, ...],
        recording: np.ndarray,
        plane: np.ndarray,
        clouds: Iterable[tuple[np.ndarray, np.ndarray]],
        noise: float,
        coarse: bool,
    ) -> Surfaces:
        """plane (P, 6): normals and points of the planes; clouds: of each LiDAR points (n, 3) m in the world, and the
        index (n,) of the plane that each lies on; coarse: an early pass, whose poses are rough."""
        codes = [np.zeros(0, dtype=np.int64)]
        for xyz, of_points in clouds:
            codes.append(_with_neighbours(np.unique(_codes(plane, of_points.astype(np.int64), xyz))))
        cells = np.unique(np.concatenate(codes))
        return cls(keys, plane, recording, cells, max(noise, MIN_COARSE_NOISE_M) if coarse else noise)

    def under(self, points: np.ndarray, information: np.ndarray, recording: np.ndarray) -> OnPlanes:
        """The plane of each of the points (n, 3) m, in the world of its `recording` (n,); none if it may lie on
        several. information (n, 3, 3) 1/m^2: of the points.

        Unobservable directions may displace cameras against LiDARs. So the test is not whether a point is close to a
        plane, but whether it is as far off as most points that may lie on it.
        """
        normal = self.plane[:, :3]
        off = points @ normal.T - np.einsum("pa,pa->p", normal, self.plane[:, 3:])
        across = np.einsum("pa,nab,pb->np", normal, np.linalg.pinv(information, hermitian=True), normal)
        may = (
            (np.abs(off) < MAX_PLANE_DISTANCE_M)
            & (across < MAX_ACROSS_SIGMA_M**2)
            & (recording[:, None] == self.recording)
        )
        i, k = np.nonzero(may)
        may[i, k] = np.isin(_codes(self.plane, k, points[i]), self.cells)
        lies = np.zeros_like(may)
        for k in np.flatnonzero(may.sum(axis=0) >= MIN_POINTS_ON_PLANE):
            own = np.flatnonzero(may[:, k])
            lies[own, k] = most_alike(off[own, k], np.sqrt(across[own, k] + self.noise**2))
        plane = np.where(lies.sum(axis=1) == 1, lies.argmax(axis=1), -1)
        on, part = np.flatnonzero(plane >= 0), np.ones(len(points))
        patches = _codes(self.plane, plane[on], points[on], PATCH_M)
        _, patch, count = np.unique(patches, return_inverse=True, return_counts=True)
        part[on] = 1.0 / count[patch]
        return OnPlanes(plane, self.noise / np.sqrt(part), part)


def most_alike(off: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(n,) bool: entries of `off` (n,), with standard deviations `sigma` (n,), that agree on one value, the one that
    most intervals of `MAX_OFF_STD` contain. None if these are few, or a small share of all."""
    ends = np.concatenate([off - MAX_OFF_STD * sigma, off + MAX_OFF_STD * sigma])
    order = np.argsort(ends, kind="stable")
    count = np.cumsum(np.where(order < len(off), 1, -1))
    best = ends[order[np.argmax(count)]]
    alike = np.abs(off - best) <= MAX_OFF_STD * sigma
    centre = np.average(off[alike], weights=sigma[alike] ** -2)
    alike = np.abs(off - centre) <= MAX_OFF_STD * sigma
    return alike & (alike.sum() >= max(MIN_POINTS_ON_PLANE, MIN_SHARE_ON_PLANE * len(off)))


def _codes(plane: np.ndarray, which: np.ndarray, xyz: np.ndarray, size: float = CELL_M) -> np.ndarray:
    """(n,) one integer for plane `which` (n,) and the cell of side `size` [m] that each point xyz (n, 3) m lies in."""
    across = np.array([tangents(np.ascontiguousarray(v[:3])) for v in plane])
    cell = np.einsum("nta,na->nt", across[which], xyz - plane[which, 3:]) / size
    i, j = np.clip(np.floor(cell), 1 - MAX_CELLS, MAX_CELLS - 2).astype(np.int64).T + MAX_CELLS
    return (which * (2 * MAX_CELLS) + i) * (2 * MAX_CELLS) + j


def _with_neighbours(codes: np.ndarray) -> np.ndarray:
    """Codes of cells and of the eight around each, because lines of few lasers are far apart."""
    steps = [a * 2 * MAX_CELLS + b for a in (-1, 0, 1) for b in (-1, 0, 1)]
    return np.unique(np.concatenate([codes + s for s in steps]))


@njit(cache=True, nogil=True)
def add_planes_to_points(on, planes, loss, points):
    """Adds the row of each point on a plane that still moves to its normal equations, with the true curvature of the
    loss."""
    for t in range(len(on.plane)):
        q = on.plane[t]
        if q < 0 or not points.moves[t]:
            continue
        n, e = planes.normal[q], _distance(planes, q, points.trial[t])
        w, cost, curvature = weight(loss.kind, loss.scale, (e / on.sigma[t]) ** 2)
        w /= on.sigma[t] ** 2
        points.trial_cost[t] += cost
        for a in range(3):
            points.trial_b[t, a] += w * e * n[a]
            for k in range(3):
                points.trial_A[t, a, k] += w * curvature * n[a] * n[k]


@njit(cache=True, nogil=True)
def _distance(planes, q, point):
    e = 0.0
    for a in range(3):
        e += planes.normal[q, a] * (point[a] - planes.point[q, a])
    return e


@njit(cache=True, nogil=True)
def _accumulate(on, planes, loss, xyz, A, features, calib, out):
    """Fills `out`, and adds the rows to the sums of the tracks and of the calibration parameters, where there are any.
    A (T, 3, 3): normal equations of the points. Returns half the robust chi^2."""
    total, M, d = 0.0, np.empty((3, 3)), np.empty(3)
    J_plane, wanted = np.empty(3), calib.shape[0] > 0
    for t in range(len(on.plane)):
        q = on.plane[t]
        out.residual[t] = out.root[t] = out.share[t] = 0.0
        if q < 0:
            continue
        n, e = planes.normal[q], _distance(planes, q, xyz[t])
        w, cost, curvature = weight(loss.kind, loss.scale, (e / on.sigma[t]) ** 2)
        w /= on.sigma[t] ** 2
        total += cost
        out.residual[t], out.root[t] = e, np.sqrt(w)
        M[:], d[:] = A[t], n
        out.share[t] = w * (d @ n) if solve_definite(M, d) else 0.0
        if wanted:
            _fill_J_plane(planes, q, xyz[t], J_plane)
            along = w * curvature if loss.curved else w
            _add_row(t, n, J_plane, planes.columns[q], along, w * e, features, calib)
    return total


@njit(cache=True, nogil=True)
def _fill_J_plane(planes, q, point, J_plane):
    """Distance of the point (3,) m from plane q by the plane's parameters, into J_plane (3,): two rotations, offset."""
    J_plane[0] = J_plane[1] = 0.0
    for a in range(3):
        J_plane[0] += planes.tangents[q, 0, a] * (point[a] - planes.point[q, a])
        J_plane[1] += planes.tangents[q, 1, a] * (point[a] - planes.point[q, a])
    J_plane[2] = -1.0


@njit(cache=True, nogil=True)
def _add_row(t, J_point, J_plane, columns, along, weighted, features, calib):
    """Adds the row of track t: derivatives J_point (3,), by its point, and J_plane (3,), by its plane with calibration
    columns (3,), -1 where fixed. along: weight of the second derivative; weighted: weight times residual."""
    n_b = calib.shape[0] - 1
    for a in range(3):
        features.side[t, a, n_b] += weighted * J_point[a]
        for k in range(3):
            features.own[t, a, k] += along * J_point[a] * J_point[k]
    for r in range(3):
        c = columns[r]
        if c < 0:
            continue
        for a in range(3):
            features.side[t, a, c] += along * J_point[a] * J_plane[r]
        for s in range(3):
            if columns[s] >= 0:
                calib[c, columns[s]] += along * J_plane[r] * J_plane[s]
        calib[c, n_b] += weighted * J_plane[r]
        calib[n_b, c] += weighted * J_plane[r]


def add_points_on_planes(
    on: OnPlanes,
    planes: Planes,
    loss: Loss,
    points: PointSearch,
    features: FeatureSums,
    piece: Piece,
    out: PlaneDistances,
) -> float:
    """Rows of points on planes, after `PointSearch`: residuals into `out`, and into the sums of `features` and of the
    calibration parameters of `piece` where these are wanted. Returns half the robust chi^2."""
    calib = piece.calib if len(features.own) else np.zeros((0, 0))
    return _accumulate(on, planes, loss, points.xyz, points.A, features, calib, out)
