"""Compiled sums of the feature factor: the search for points of the scene, and the normal equations of a piece.

Images are those of one camera in a piece. Observations, tracks and pairs (a track with one of its images) are counted
from the first one of the recording; `PieceStart` says where the piece begins. J_rows holds Jacobians transposed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.blas import subtract_gram
from icalib.geometry.planes import tangents
from icalib.geometry.small import eigen3, solve_definite
from icalib.motion.sensor_pose import chain_width, fill_chain
from icalib.optim.robust_weights import correct_curvature, weight
from icalib.optim.rows import add_gram
from icalib.optim.state import KEYFRAME_DIM

MIN_COST_DECREASE = 1e-9  # of half the chi^2: a smaller step of a point is its last; from 1e-8 on gradients show it
MIN_EIGENVALUE_RATIO = 1e-15  # to the largest eigenvalue: a smaller one counts as zero (rounding)
INITIAL_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-6, 1e8  # of Levenberg-Marquardt, times the diagonal
MAX_DISTANCE_M = 1e5  # of a point from its anchor camera; farther ones look the same
AT_MAX_SHARE = 1.0 - 1e-6  # of MAX_DISTANCE_M, from which a point counts as being there


class TrackObservations(NamedTuple):
    """Observations by one camera in n images.

    start (n + 1,): observations of image i are start[i]:start[i+1]; uv (N, 2) px; keep (N,) bool, in use; track (N,)
    and pair (N,) indices, -1 where the track is left out; keyframe (n,), counted from the piece's first; sigma (N,) px
    per axis."""

    start: np.ndarray
    uv: np.ndarray
    keep: np.ndarray
    track: np.ndarray
    pair: np.ndarray
    keyframe: np.ndarray
    sigma: np.ndarray


class PieceStart(NamedTuple):
    """The first track and the first pair of a piece."""

    track: int
    pair: int


class TrackProjection(NamedTuple):
    """The camera model at observations `first` and on.

    uv (n, 2) px; valid (n,) bool, within the range of the model; Jacobians of uv by the point in the camera J_point
    (n, 2, 3) and by the model's parameters J_params (n, 2, P), of which `pars` (d,) are free."""

    first: int
    uv: np.ndarray
    valid: np.ndarray
    J_point: np.ndarray
    J_params: np.ndarray
    pars: np.ndarray


class PointSearch(NamedTuple):
    """Levenberg-Marquardt of T points, each on its own, poses and calibration fixed.

    anchor (T, 3) m: position of the camera that each point moves with; xyz and trial (T, 3) m, in the world; cost and
    trial_cost (T,): half the robust chi^2; A (T, 3, 3) and b (T, 3), trial_A and trial_b: normal equations; shown and
    trial_shown (T,): number of valid observations; damping (T,); moves (T,) bool: not converged yet."""

    anchor: np.ndarray
    xyz: np.ndarray
    trial: np.ndarray
    cost: np.ndarray
    trial_cost: np.ndarray
    A: np.ndarray
    b: np.ndarray
    trial_A: np.ndarray
    trial_b: np.ndarray
    shown: np.ndarray
    trial_shown: np.ndarray
    damping: np.ndarray
    moves: np.ndarray


@njit(cache=True, nogil=True)
def camera_points(observed, t0, R_cam_world, p_world_cam, points, X):
    """Point of each observation in the camera frame, into X (n, 3) m; (0, 0, 1) where the track is left out. points
    (T, 3) m, in the world: those of tracks t0 and on."""
    o = observed.start[0]
    for i in range(len(observed.start) - 1):
        for n in range(observed.start[i], observed.start[i + 1]):
            t = observed.track[n]
            if t < 0:
                X[n - o, 0], X[n - o, 1], X[n - o, 2] = 0.0, 0.0, 1.0
            else:
                _in_camera(R_cam_world[i], p_world_cam[i], points[t - t0], X[n - o])


@njit(cache=True, nogil=True)
def _in_camera(R_cam_world, p_world_cam, point, x):
    a, b, c = point[0] - p_world_cam[0], point[1] - p_world_cam[1], point[2] - p_world_cam[2]
    for r in range(3):
        x[r] = R_cam_world[r, 0] * a + R_cam_world[r, 1] * b + R_cam_world[r, 2] * c


@njit(cache=True, nogil=True)
def moving_points(observed, t0, R_cam_world, p_world_cam, points, image, which, X):
    """Observations in use of points that still move. Returns their number m. Fills image (m,) and which (m,), indices
    of image and observation, and X (m, 3) m, trial points in the camera frame."""
    m = 0
    for i in range(len(observed.start) - 1):
        for n in range(observed.start[i], observed.start[i + 1]):
            if observed.track[n] >= 0 and observed.keep[n] and points.moves[observed.track[n] - t0]:
                image[m], which[m] = i, n
                _in_camera(R_cam_world[i], p_world_cam[i], points.trial[observed.track[n] - t0], X[m])
                m += 1
    return m


@njit(cache=True, nogil=True)
def add_rays(observed, t0, R_cam_world, p_world_cam, rays, valid, A, b):
    """Adds each ray (n, 3), a unit vector in the camera frame, to A (T, 3, 3) and b (T, 3) of its point: A P = b is the
    point nearest to all rays (midpoint triangulation)."""
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
    """Adds observations `which` (m,) by one camera, of image (m,), to costs and normal equations of the trial points,
    with the true curvature of the loss. uv (m, 2), valid (m,), J_point (m, 2, 3): the camera model at the trial."""
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
        points.trial_shown[t] += 1
        for a in range(3):
            slope = J[0, a] * e[0] + J[1, a] * e[1]
            points.trial_b[t, a] += w * slope
            for k in range(3):
                bent = less * slope * (J[0, k] * e[0] + J[1, k] * e[1])
                points.trial_A[t, a, k] += w * (J[0, a] * J[0, k] + J[1, a] * J[1, k] - bent)


@njit(cache=True, nogil=True)
def take_trials(points, start):
    """One iteration of `PointSearch`: accepts trials that lower the cost (all at the `start`) and sets new ones.

    Returns how many points still move. A last step is taken untried: cost and sums stay those of its beginning."""
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
    """Accepts the trial of point t at the `start`, or where it lowers the cost. It must not lower the cost by leaving
    an image, so the number of valid observations must not fall. The damping follows."""
    stays = points.trial_shown[t] >= points.shown[t]
    if start or (stays and points.trial_cost[t] <= points.cost[t]):
        points.shown[t] = points.trial_shown[t]
        points.xyz[t], points.cost[t] = points.trial[t], points.trial_cost[t]
        points.A[t], points.b[t] = points.trial_A[t], points.trial_b[t]
        points.damping[t] *= 0.1
        if points.damping[t] < MIN_DAMPING:
            points.damping[t] = 0.0
    else:
        points.damping[t] = max(10.0 * points.damping[t], INITIAL_DAMPING)


@njit(cache=True, nogil=True)
def _clear_trial(points, t):
    """Sets the sums at the trial of point t to zero."""
    for a in range(3):
        points.trial_b[t, a] = 0.0
        for k in range(3):
            points.trial_A[t, a, k] = 0.0
    points.trial_cost[t], points.trial_shown[t] = 0.0, 0


@njit(cache=True, nogil=True)
def _ray_axes(anchor, point, axes):
    """Three perpendicular unit vectors into the rows of axes (3, 3), the last from `anchor` to `point`. Returns their
    distance [m]."""
    x, y, z = point[0] - anchor[0], point[1] - anchor[1], point[2] - anchor[2]
    distance = max(np.sqrt(x * x + y * y + z * z), 1e-9)
    axes[2, 0], axes[2, 1], axes[2, 2] = x / distance, y / distance, z / distance
    axes[:2] = tangents(axes[2])
    return distance


@njit(cache=True, nogil=True)
def _step(axes, A, b, damping, at_end, M, d):
    """Damped Newton step into d (3,) m along `axes`, not farther out if the point is `at_end` of the range. False where
    the normal equations A, b are not positive definite."""
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
    """Rotates normal equations: M = axes A axes^T, d = -axes b."""
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
    """Moves `point`, at `distance` [m] from `anchor`, by d (3,) m along `axes`, in inverse-depth coordinates (Civera et
    al. 2008). The projection is nearly linear in direction and inverse distance, so no step leads behind the camera."""
    nearness = max((1.0 - d[2] / distance) / distance, 1.0 / MAX_DISTANCE_M)
    size = 0.0
    for a in range(3):
        point[a] = axes[2, a] + (d[0] * axes[0, a] + d[1] * axes[1, a]) / distance
        size += point[a] * point[a]
    for a in range(3):
        point[a] = anchor[a] + point[a] / (np.sqrt(size) * nearness)


@njit(cache=True, nogil=True)
def held_back(own, gradient):
    """Twice the decrease of cost that points with normal equations own (T, 3, 3) and gradient (T, 3) still predict.

    It is above zero for points that the border of an image stops. The solver must not count it as the gain of a step.
    Directions without information, as of a point at a camera's centre, predict no decrease.
    """
    A, values, vectors, total = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), 0.0
    for t in range(len(own)):
        A[:] = own[t]
        eigen3(A, values, vectors)
        for k in range(3):
            if values[k] > MIN_EIGENVALUE_RATIO * values[2]:
                along = 0.0
                for a in range(3):
                    along += vectors[a, k] * gradient[t, a]
                total += along * along / values[k]
    return total


@njit(cache=True, nogil=True)
def weighted_rows(i, n, X, observed, projection, loss, R_cam_world, error, J_rows):
    """Weighted rows of observation n of image i, transposed, into J_rows (6 + d + 3 + 1, 2): by camera pose, free
    parameters and point, and the residual; error (2,) px. Returns root, square root of the weight over sigma [1/px], 0
    where it is not in use, and half the robust chi^2."""
    c, D = n - projection.first, len(J_rows) - 1
    for r in range(2):
        error[r] = projection.uv[c, r] - observed.uv[n, r]
    if not (observed.keep[n] and projection.valid[c]):
        return 0.0, 0.0
    square = (error[0] ** 2 + error[1] ** 2) / (observed.sigma[n] * observed.sigma[n])
    w, cost, curvature = weight(loss.kind, loss.scale, square)
    root = np.sqrt(w) / observed.sigma[n]
    x, y, z = X[c, 0], X[c, 1], X[c, 2]
    for r in range(2):
        a0, a1, a2 = (
            root * projection.J_point[c, r, 0],
            root * projection.J_point[c, r, 1],
            root * projection.J_point[c, r, 2],
        )
        J_rows[0, r], J_rows[1, r], J_rows[2, r] = a1 * z - a2 * y, a2 * x - a0 * z, a0 * y - a1 * x
        J_rows[3, r], J_rows[4, r], J_rows[5, r] = -a0, -a1, -a2
        for q in range(len(projection.pars)):
            J_rows[6 + q, r] = root * projection.J_params[c, r, projection.pars[q]]
        for k in range(3):
            J_rows[D - 3 + k, r] = a0 * R_cam_world[i, 0, k] + a1 * R_cam_world[i, 1, k] + a2 * R_cam_world[i, 2, k]
        J_rows[D, r] = root * error[r]
    if loss.curved and curvature < 1.0:
        correct_curvature(J_rows, D, 0, 1, error, np.sqrt(curvature))
    return root, cost


@njit(cache=True, nogil=True)
def _gram(rows, G):
    """G = rows^T rows."""
    G[:] = 0.0
    subtract_gram(rows, G)
    for a in range(len(G)):
        for b in range(a, len(G)):
            G[a, b] = G[b, a] = -G[a, b]


@njit(cache=True, nogil=True)
def _add_feature(i, J_rows, pair, t, J_chain, n_chain, columns, features, by_pose):
    """Adds rows J_rows of one observation, of image i, to the sums of its track t. J_chain (6, w): camera pose by
    keyframes and calibration parameters; columns (n, c + d): of all images; by_pose (6,): workspace."""
    D, n_b, side, block = len(J_rows) - 1, features.side.shape[2] - 1, features.side[t], features.block[pair]
    n_c = J_chain.shape[1] - n_chain
    for a in range(3):
        f0, f1 = J_rows[D - 3 + a, 0], J_rows[D - 3 + a, 1]
        for k in range(3):
            features.own[t, a, k] += f0 * J_rows[D - 3 + k, 0] + f1 * J_rows[D - 3 + k, 1]
        side[a, n_b] += f0 * J_rows[D, 0] + f1 * J_rows[D, 1]
        for q in range(n_c, columns.shape[1]):
            side[a, columns[i, q]] += f0 * J_rows[6 + q - n_c, 0] + f1 * J_rows[6 + q - n_c, 1]
        for d in range(6):
            by_pose[d] = f0 * J_rows[d, 0] + f1 * J_rows[d, 1]
            block[a, d] += by_pose[d]
        for j in range(n_c):
            if columns[i, j] >= 0:
                s = 0.0
                for d in range(6):
                    s += by_pose[d] * J_chain[d, n_chain + j]
                side[a, columns[i, j]] += s


@njit(cache=True, nogil=True)
def _fill_pose(i, poses, J_imu, J_chain, features):
    """Camera pose i by keyframes and calibration parameters into J_chain (6, w); by keyframes into `features`, too."""
    fill_chain(i, poses, J_imu, J_chain)
    for d in range(6):
        for j in range(KEYFRAME_DIM):
            features.pose[i, d, j] = J_chain[d, j]
        for j in range(KEYFRAME_DIM if len(features.next_pose) else 0):
            features.next_pose[i, d, j] = J_chain[d, KEYFRAME_DIM + j]


@njit(cache=True, nogil=True)
def accumulate(X, observed, base, poses, columns, projection, loss, sums, features, residual, root):
    """Residual (N, 2) px and root (N,) of observations by one camera, and the normal equations where they are wanted.

    X (n, 3) m: their points in the camera; poses: of the camera; columns (n, c + d): see `CameraImages`. Returns half
    the robust chi^2."""
    n_d, n_chain, width = len(projection.pars), chain_width(poses), chain_width(poses) + columns.shape[1]
    J_rows, G, error = np.zeros((10 + n_d, 2)), np.empty((7 + n_d, 7 + n_d)), np.empty(2)
    by_pose, most = np.empty(6), 0
    for i in range(len(observed.start) - 1):
        most = max(most, observed.start[i + 1] - observed.start[i])
    rows = np.empty((2 * most, 7 + n_d))
    J_imu, J_chain, F = np.empty((6, 6)), np.empty((6, width - n_d)), np.empty((6, width + 1))
    total, D, wanted = 0.0, 9 + n_d, len(sums.diagonal) > 0
    for i in range(len(observed.start) - 1):
        if wanted:
            _fill_pose(i, poses, J_imu, J_chain, features)
        m = 0
        for n in range(observed.start[i], observed.start[i + 1]):
            t = observed.track[n] - base.track
            if observed.track[n] < 0:
                root[n], residual[n, 0], residual[n, 1] = 0.0, 0.0, 0.0
                continue
            root[n], cost = weighted_rows(i, n, X, observed, projection, loss, poses.R_sensor_world, error, J_rows)
            residual[n, 0], residual[n, 1] = error[0], error[1]
            total += cost
            if not wanted or root[n] == 0.0:
                continue
            for r in range(2):
                for a in range(6 + n_d):
                    rows[m + r, a] = J_rows[a, r]
                rows[m + r, 6 + n_d] = J_rows[D, r]
            m += 2
            _add_feature(i, J_rows, observed.pair[n] - base.pair, t, J_chain, n_chain, columns, features, by_pose)
        if wanted:
            _gram(rows[:m], G)
            add_gram(observed.keyframe[i], n_chain, G, J_chain, columns[i], F, sums)
    return total
