"""Tracked points on planes of LiDARs. They link cameras to LiDARs if the motion does not determine the extrinsics.

A point P on the plane with normal n through q has one residual, with standard deviation `points_on_planes_m`:

    residual = n . (P - q)

Relief of a surface causes errors that do not average out over observations, nor over nearby points. So all points of
one patch of a plane together have the weight of a single point.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.data.measurements import TrackStream
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.planes import tangents
from icalib.geometry.small import solve_definite
from icalib.optim.arrowhead import Piece
from icalib.optim.front import FeatureSums
from icalib.optim.rows import Loss, weight
from icalib.optim.state import KEYFRAME_DIM, Key, Planes
from icalib.sensors.camera.track_kernels import in_camera

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
NO_SUMS = FeatureSums.zeros(
    0, NO_NUMBERS, NO_NUMBERS, NO_NUMBERS, (KEYFRAME_DIM, 1)
)  # of passes without normal equations


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


# Compiled search for the scene points of tracks that minimise their reprojection cost, with poses and lenses fixed.
#
# Indices of observations and tracks count as in `kernels`.

MIN_COST_DECREASE = 1e-9  # of half the chi^2, below which a point has converged; from 1e-8 on, gradients are inexact
INITIAL_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-6, 1e8  # of Levenberg-Marquardt, relative to the diagonal
MAX_DISTANCE_M = 1e5  # of a point from its anchor camera; farther points have no measurable parallax
AT_MAX_SHARE = 1.0 - 1e-6  # of MAX_DISTANCE_M, above which a point counts as being at this limit


class PointSearch(NamedTuple):
    """State of independent Levenberg-Marquardt searches for T points, with poses and calibration fixed.

    anchor (T, 3) m: position of each point's anchor camera, from which inverse depth is counted. xyz, trial (T, 3) m:
    accepted and trial points; all three in the world frame. cost, trial_cost (T,): half the robust chi^2; A (T, 3, 3)
    and b (T, 3), trial_A and trial_b: normal equations; n_valid, trial_n_valid (T,): number of valid observations;
    damping (T,); moves (T,) bool: not converged yet."""

    anchor: np.ndarray
    xyz: np.ndarray
    trial: np.ndarray
    cost: np.ndarray
    trial_cost: np.ndarray
    A: np.ndarray
    b: np.ndarray
    trial_A: np.ndarray
    trial_b: np.ndarray
    n_valid: np.ndarray
    trial_n_valid: np.ndarray
    damping: np.ndarray
    moves: np.ndarray


@njit(cache=True, nogil=True)
def moving_points(observed, t0, R_cam_world, p_world_cam, points, image, which, X):
    """Selects the m observations in use whose points have not converged, and returns m.

    Writes the indices image (m,) and which (m,) of image and observation, and X (m, 3) m, the trial points in the
    camera frame. t0: number of the first track in `points`."""
    m = 0
    for i in range(len(observed.start) - 1):
        for n in range(observed.start[i], observed.start[i + 1]):
            if observed.track[n] >= 0 and observed.keep[n] and points.moves[observed.track[n] - t0]:
                image[m], which[m] = i, n
                in_camera(R_cam_world[i], p_world_cam[i], points.trial[observed.track[n] - t0], X[m])
                m += 1
    return m


@njit(cache=True, nogil=True)
def add_rays(observed, t0, R_cam_world, p_world_cam, rays, valid, A, b):
    """Adds the rays (n, 3), unit vectors in the camera frame, to the equations A P = b of their points P.

    The solution is the point nearest to all its rays (midpoint triangulation). A (T, 3, 3) and b (T, 3) m belong to the
    tracks from number t0 on, in the world frame; valid (n,) bool: rays to use."""
    o, d = observed.start[0], np.empty(3)
    for i in range(len(observed.start) - 1):
        for n in range(observed.start[i], observed.start[i + 1]):
            t = observed.track[n]
            if t < 0 or not (observed.keep[n] and valid[n - o]):
                continue
            for r in range(3):
                d[r] = 0.0
                for k in range(3):
                    d[r] += R_cam_world[i, k, r] * rays[n - o, k]
            along = d[0] * p_world_cam[i, 0] + d[1] * p_world_cam[i, 1] + d[2] * p_world_cam[i, 2]
            for r in range(3):
                b[t - t0, r] += p_world_cam[i, r] - along * d[r]
                A[t - t0, r, r] += 1.0
                for k in range(3):
                    A[t - t0, r, k] -= d[r] * d[k]


@njit(cache=True, nogil=True)
def add_to_points(observed, t0, R_cam_world, image, which, uv, valid, J_point, loss, points):
    """Adds the observations `which` (m,), in images image (m,) of one camera, to the equations of the trial points.

    Normal equations have the true curvature of the loss. uv (m, 2) px, valid (m,), J_point (m, 2, 3): projections of
    the trial points, and their Jacobians by the point in the camera frame."""
    J, e = np.empty((2, 3)), np.empty(2)
    for m in range(len(which)):
        n, R = which[m], R_cam_world[image[m]]
        t = observed.track[n] - t0
        if not valid[m]:
            continue
        for r in range(2):
            e[r] = uv[m, r] - observed.uv[n, r]
            for k in range(3):
                J[r, k] = J_point[m, r, 0] * R[0, k] + J_point[m, r, 1] * R[1, k] + J_point[m, r, 2] * R[2, k]
        variance = observed.sigma[n] * observed.sigma[n]
        square = (e[0] * e[0] + e[1] * e[1]) / variance
        w, cost, curvature = weight(loss.kind, loss.scale, square)
        w /= variance
        less = (1.0 - curvature) / (e[0] * e[0] + e[1] * e[1]) if curvature < 1.0 else 0.0
        points.trial_cost[t] += cost
        points.trial_n_valid[t] += 1
        for a in range(3):
            slope = J[0, a] * e[0] + J[1, a] * e[1]
            points.trial_b[t, a] += w * slope
            for k in range(3):
                bent = less * slope * (J[0, k] * e[0] + J[1, k] * e[1])
                points.trial_A[t, a, k] += w * (J[0, a] * J[0, k] + J[1, a] * J[1, k] - bent)


@njit(cache=True, nogil=True)
def take_trials(points, start):
    """One iteration of `PointSearch`: accepts trials that lower the cost (all at the `start`) and sets new trials.

    Returns the number of points that have not converged. The last step of a point is taken without evaluation; its cost
    and normal equations stay those before this step."""
    M, d, axes, moving = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), 0
    for t in range(len(points.xyz)):
        if not points.moves[t]:
            continue
        _take_trial(points, t, start)
        distance = _ray_axes(points.anchor[t], points.xyz[t], axes)
        at_end = distance > AT_MAX_SHARE * MAX_DISTANCE_M
        while points.damping[t] < MAX_DAMPING:
            if _step(axes, points.A[t], points.b[t], points.damping[t], at_end, M, d):
                break
            points.damping[t] = max(10.0 * points.damping[t], INITIAL_DAMPING)
        decrease = 0.0
        for a in range(3):
            for k in range(3):
                decrease -= 0.5 * d[a] * axes[a, k] * points.b[t, k]
        if points.damping[t] >= MAX_DAMPING:
            points.moves[t] = False
            continue
        _move(points.anchor[t], axes, distance, d, points.trial[t])
        if points.damping[t] == 0.0 and decrease < MIN_COST_DECREASE:
            points.xyz[t], points.moves[t] = points.trial[t], False
            continue
        moving += 1
        _clear_trial(points, t)
    return moving


@njit(cache=True, nogil=True)
def _take_trial(points, t, start):
    """Accepts the trial of point t at the `start`, or if it does not raise the cost; then updates the damping.

    A point could lower its cost by leaving an image, so the number of valid observations must not fall."""
    stays = points.trial_n_valid[t] >= points.n_valid[t]
    if start or (stays and points.trial_cost[t] <= points.cost[t]):
        points.n_valid[t] = points.trial_n_valid[t]
        points.xyz[t], points.cost[t] = points.trial[t], points.trial_cost[t]
        points.A[t], points.b[t] = points.trial_A[t], points.trial_b[t]
        points.damping[t] *= 0.1
        if points.damping[t] < MIN_DAMPING:
            points.damping[t] = 0.0
    else:
        points.damping[t] = max(10.0 * points.damping[t], INITIAL_DAMPING)


@njit(cache=True, nogil=True)
def _clear_trial(points, t):
    """Sets cost, normal equations and number of observations of the trial of point t to zero."""
    for a in range(3):
        points.trial_b[t, a] = 0.0
        for k in range(3):
            points.trial_A[t, a, k] = 0.0
    points.trial_cost[t], points.trial_n_valid[t] = 0.0, 0


@njit(cache=True, nogil=True)
def _ray_axes(anchor, point, axes):
    """Writes three perpendicular unit vectors into the rows of axes (3, 3); the last points from `anchor` to `point`.

    Returns the distance [m] of anchor and point."""
    x, y, z = point[0] - anchor[0], point[1] - anchor[1], point[2] - anchor[2]
    distance = max(np.sqrt(x * x + y * y + z * z), 1e-9)
    axes[2, 0], axes[2, 1], axes[2, 2] = x / distance, y / distance, z / distance
    axes[:2] = tangents(axes[2])
    return distance


@njit(cache=True, nogil=True)
def _step(axes, A, b, damping, at_end, M, d):
    """Writes a damped Newton step, in the coordinates of `axes`, into d (3,) m. False if A is not positive definite.

    A (3, 3), b (3,): normal equations; M (3, 3): workspace. If the point is `at_end` of the range, it does not move
    farther out."""
    for outwards in (True, False):
        _along(axes, A, b, M, d)
        for a in range(3):
            M[a, a] *= 1.0 + damping
        if not outwards:
            M[2, 0] = M[0, 2] = M[2, 1] = M[1, 2] = d[2] = 0.0
        if not solve_definite(M, d):
            return False
        if not at_end or d[2] <= 0.0:
            break
    return True


@njit(cache=True, nogil=True)
def _along(axes, A, b, M, d):
    """Rotates normal equations A, b into `axes`: writes M = axes A axes^T and d = -axes b."""
    for i in range(3):
        d[i] = 0.0
        for a in range(3):
            d[i] -= axes[i, a] * b[a]
        for j in range(3):
            M[i, j] = 0.0
            for a in range(3):
                for k in range(3):
                    M[i, j] += axes[i, a] * A[a, k] * axes[j, k]


@njit(cache=True, nogil=True)
def _move(anchor, axes, distance, d, point):
    """Writes the point at `distance` [m] from `anchor` along axes[2], after a step d (3,) m along `axes`, into `point`.

    The step is made in direction and inverse distance (inverse depth; Civera et al. 2008), in which the projection is
    nearly linear. So no step leads behind the camera."""
    nearness = max((1.0 - d[2] / distance) / distance, 1.0 / MAX_DISTANCE_M)
    size = 0.0
    for a in range(3):
        point[a] = axes[2, a] + (d[0] * axes[0, a] + d[1] * axes[1, a]) / distance
        size += point[a] * point[a]
    for a in range(3):
        point[a] = anchor[a] + point[a] / (np.sqrt(size) * nearness)


# Corrects observations of feature tracks for the curvature that the lens gives to their patches.
#
# A tracker aligns the patch around a feature's first view with the image under an affine map. A lens maps a patch
# affinely to first order only. Its second-order terms move the point that the alignment reports away from the image of
# the patch's mean ray, by
#
#     b = 1/2 spread (d^2 pi / da^2 + d^2 pi / db^2)
#
# with pi the projection, a and b perpendicular directions on the sphere of rays, scaled to one pixel, and `spread`
# [px^2] the second moment of the patch with the weights of the alignment. The displacement b grows towards the border
# of the image, and would bias the calibrated distortion. The observation is replaced by the projection of the mean
# ray.

# Unit directions in the image from an observation to four points around it.
_AROUND = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def with_curved_patches(stream: TrackStream, model: CameraModel, params: np.ndarray) -> TrackStream:
    """The stream with corrected observations, for lens parameters `params` (P,).

    Unchanged if the stream has no spread. Observations whose patch is outside the range of the lens model stay."""
    if not len(stream.spread):
        return stream
    # Four points at this distance from the observation have the same second moment as the patch.
    reach = np.sqrt(2.0 * stream.spread)[:, None]
    mean, has_rays = np.zeros((len(stream.uv), 3)), np.ones(len(stream.uv), dtype=bool)
    for direction in _AROUND:
        ray, valid = model.unproject(params, stream.uv + reach * direction)
        mean += ray
        has_rays &= valid
    uv, valid = model.project(params, np.where(has_rays[:, None], mean, [0.0, 0.0, 1.0]))
    return replace(stream, uv=np.where((has_rays & valid)[:, None], uv, stream.uv))
