"""Tracked points on planes of LiDARs. They link cameras to LiDARs if the motion does not determine the extrinsics.

A point P on the plane with normal n through q has one residual, with standard deviation `points_on_planes_m`:

    residual = n . (P - q)

Relief of a surface causes errors that do not average out over observations, nor over nearby points. So all points of
one patch of a plane together have the weight of a single point.
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

ON_PLANES = "points on planes"  # kind of residual
# Side of a grid cell. Planes extend over cells in which a LiDAR has points. Smaller cells leave gaps between the scan
# lines of LiDARs with few lasers.
CELL_M = 0.25
PATCH_M = 1.0  # side of a patch, within which errors by relief correlate
MAX_OFF_STD = 3.0  # largest distance of a point from its plane, in standard deviations
MAX_PLANE_DISTANCE_M = 0.5  # of candidate points from a plane: largest initial misalignment of cameras and LiDARs
MAX_ACROSS_SIGMA_M = 0.1  # standard deviation of a point normal to the plane, above which it is no candidate
# Number of candidate points that must agree on their distance from a plane, and their share of all its candidates.
MIN_POINTS_ON_PLANE, MIN_SHARE_ON_PLANE = 20, 0.4
MIN_COARSE_NOISE_M = 0.05  # smallest noise in early passes, which have rough poses
MAX_CELLS = 1 << 20  # largest distance from a plane's origin, in cells, so that cell codes fit into 64 bits


class OnPlanes(NamedTuple):
    """Planes of T tracks.

    plane (T,): index, -1 if the point is on no plane; sigma (T,) m: standard deviation of its residual; weight (T,):
    one over the number of points on the same patch."""

    plane: np.ndarray
    sigma: np.ndarray
    weight: np.ndarray

    @classmethod
    def none(cls, n: int) -> OnPlanes:
        return cls(np.full(n, -1), np.ones(n), np.ones(n))

    def of(self, tracks: slice) -> OnPlanes:
        return OnPlanes(*(a[tracks] for a in self))


NO_PLANES = OnPlanes.none(0)
NO_NUMBERS = np.zeros(0, dtype=np.int64)
NO_SUMS = FeatureSums.zeros(0, NO_NUMBERS, NO_NUMBERS, NO_NUMBERS, 0)  # of passes without normal equations


class PlaneDistances(NamedTuple):
    """Distances of T points from their planes.

    residual (T,) m; root (T,) 1/m: square root of the robust weight over sigma, 0 for points on no plane; share (T,),
    0 to 1: degrees of freedom of the point, out of three, that the plane determines."""

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
    """The P planes of LiDARs in a pass, and the grid cells in which LiDARs observe them.

    keys: keys of the planes in a state; plane (P, 6): unit normal, and a point of the plane [m], at the start of the
    pass, in the world of its recording; recording (P,): index of this recording; cells: sorted codes of the observed
    cells, see `_codes`; noise [m]: standard deviation of points normal to their plane."""

    keys: tuple[Key, ...]
    plane: np.ndarray
    recording: np.ndarray
    cells: np.ndarray
    noise: float

    @classmethod
    def of_clouds(
        cls,
        keys: tuple[Key, ...],
        recording: np.ndarray,
        plane: np.ndarray,
        clouds: Iterable[tuple[np.ndarray, np.ndarray]],
        noise: float,
        coarse: bool,
    ) -> Surfaces:
        """The planes with the cells that the points of `clouds` observe, and all neighbours of these cells.

        plane (P, 6): see `Surfaces`; clouds: for each LiDAR points (n, 3) m in the world, and the index (n,) of the
        plane of each; noise [m]; coarse: whether this is an early pass with rough poses."""
        codes = [np.zeros(0, dtype=np.int64)]
        for xyz, of_points in clouds:
            codes.append(_with_neighbours(np.unique(_codes(plane, of_points.astype(np.int64), xyz))))
        cells = np.unique(np.concatenate(codes))
        return cls(keys, plane, recording, cells, max(noise, MIN_COARSE_NOISE_M) if coarse else noise)

    def under(self, points: np.ndarray, information: np.ndarray, recording: np.ndarray) -> OnPlanes:
        """Associates the points (n, 3) m, in the world of their `recording` (n,), with planes; a point with several
        possible planes gets none.

        information (n, 3, 3) 1/m^2: inverse covariance of each point. Cameras may be displaced against LiDARs along
        unobservable directions. So the test is not whether a point is close to a plane, but whether its distance
        agrees with that of most candidates of the plane.
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
            candidates = np.flatnonzero(may[:, k])
            lies[candidates, k] = most_alike(off[candidates, k], np.sqrt(across[candidates, k] + self.noise**2))
        plane = np.where(lies.sum(axis=1) == 1, lies.argmax(axis=1), -1)
        on, part = np.flatnonzero(plane >= 0), np.ones(len(points))
        patches = _codes(self.plane, plane[on], points[on], PATCH_M)
        _, patch, count = np.unique(patches, return_inverse=True, return_counts=True)
        part[on] = 1.0 / count[patch]
        return OnPlanes(plane, self.noise / np.sqrt(part), part)


def most_alike(off: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(n,) bool: values `off` (n,), with standard deviations `sigma` (n,), that agree on one common value.

    The common value is the one within `MAX_OFF_STD` sigma of most entries. All False if few entries, or a small share
    of them, agree."""
    ends = np.concatenate([off - MAX_OFF_STD * sigma, off + MAX_OFF_STD * sigma])
    order = np.argsort(ends, kind="stable")
    count = np.cumsum(np.where(order < len(off), 1, -1))
    best = ends[order[np.argmax(count)]]
    alike = np.abs(off - best) <= MAX_OFF_STD * sigma
    centre = np.average(off[alike], weights=sigma[alike] ** -2)
    alike = np.abs(off - centre) <= MAX_OFF_STD * sigma
    return alike & (alike.sum() >= max(MIN_POINTS_ON_PLANE, MIN_SHARE_ON_PLANE * len(off)))


def _codes(plane: np.ndarray, which: np.ndarray, xyz: np.ndarray, size: float = CELL_M) -> np.ndarray:
    """(n,) integer code of plane `which` (n,) and its grid cell, of side `size` [m], of each point xyz (n, 3) m."""
    across = np.array([tangents(np.ascontiguousarray(v[:3])) for v in plane])
    cell = np.einsum("nta,na->nt", across[which], xyz - plane[which, 3:]) / size
    i, j = np.clip(np.floor(cell), 1 - MAX_CELLS, MAX_CELLS - 2).astype(np.int64).T + MAX_CELLS
    return (which * (2 * MAX_CELLS) + i) * (2 * MAX_CELLS) + j


def _with_neighbours(codes: np.ndarray) -> np.ndarray:
    """Codes of cells and of their eight neighbours, because the scan lines of LiDARs with few lasers are far apart."""
    steps = [a * 2 * MAX_CELLS + b for a in (-1, 0, 1) for b in (-1, 0, 1)]
    return np.unique(np.concatenate([codes + s for s in steps]))


@njit(cache=True, nogil=True)
def add_planes_to_points(on, planes, loss, points):
    """Adds the plane residual of each point that has not converged to its trial normal equations.

    These have the true curvature of the loss. on: planes of the points; planes: their values."""
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
    """Signed distance [m] of `point` (3,) m from plane q."""
    e = 0.0
    for a in range(3):
        e += planes.normal[q, a] * (point[a] - planes.point[q, a])
    return e


@njit(cache=True, nogil=True)
def _accumulate(on, planes, loss, xyz, A, features, calib, out):
    """Writes residuals, weights and shares into `out`, and returns half the robust chi^2.

    Adds normal equations to `features` and to calib (B + 1, B + 1), unless calib is empty. xyz (T, 3) m: points;
    A (T, 3, 3) 1/m^2: their normal matrices."""
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
    """Writes the Jacobian of the point's distance by the parameters of plane q into J_plane (3,): two tilts, offset."""
    J_plane[0] = J_plane[1] = 0.0
    for a in range(3):
        J_plane[0] += planes.tangents[q, 0, a] * (point[a] - planes.point[q, a])
        J_plane[1] += planes.tangents[q, 1, a] * (point[a] - planes.point[q, a])
    J_plane[2] = -1.0


@njit(cache=True, nogil=True)
def _add_row(t, J_point, J_plane, columns, along, weighted, features, calib):
    """Adds the plane residual of track t to the normal equations.

    J_point (3,), J_plane (3,): its Jacobians by point and plane; columns (3,): indices of the plane's calibration
    parameters, -1 where fixed; along: weight of J^T J; weighted: weight times residual."""
    n_b = calib.shape[0] - 1
    for a in range(3):
        features.side[t, a, n_b] += weighted * J_point[a]
        for k in range(3):
            features.diagonal[t, a, k] += along * J_point[a] * J_point[k]
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
    on: OnPlanes, planes: Planes, loss: Loss, points: PointSearch, piece: Piece | None, out: PlaneDistances
) -> float:
    """Writes the plane residuals at the points of `PointSearch` into `out`, and returns half the robust chi^2.

    Adds their normal equations to the tracks and calibration parameters of `piece`; not if it is None or has no
    tracks."""
    features, calib = NO_SUMS, np.zeros((0, 0))
    if piece is not None and piece.features is not None and len(piece.features.sums.diagonal):
        features, calib = piece.features.sums, piece.calib
    return _accumulate(on, planes, loss, points.xyz, points.A, features, calib, out)
