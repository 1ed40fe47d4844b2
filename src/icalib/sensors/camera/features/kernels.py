"""Compiled sums of the feature factor: points from what is seen of them, and the normal equations of a piece.

Images are those of one camera in the piece, observations counted from the first of the recording, tracks and pairs from
the first of the recording too; `Range` says where the piece begins.
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

# Of half the chi^2: a point's step that takes off less is its last. What that leaves is the square of it, but where a
# robust loss bends a part of it; from 1e-8 on gradients show that.
SETTLED = 1e-9
NO_INVERSE = 1e-15  # of the largest eigenvalue: one that is smaller is nought
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-6, 1e8
FARTHEST_M, AT_END = 1e5, 1.0 - 1e-6  # of a point from the camera that it moves with


class Seen(NamedTuple):
    """What one camera saw: observations of image i are start[i]:start[i + 1]; uv (N, 2), keep (N,), track (N,) -1 where
    left out; pair (N,) of feature and image (-1: none); keyframe (n,), counted from the piece's first; sigma (N,)
    px."""

    start: np.ndarray
    uv: np.ndarray
    keep: np.ndarray
    track: np.ndarray
    pair: np.ndarray
    keyframe: np.ndarray
    sigma: np.ndarray


class Range(NamedTuple):
    """The first track and the first pair of the piece."""

    track: int
    pair: int


class Seeing(NamedTuple):
    """What the model makes of observations `first` and on: uv, valid, Jacobians by the point in the camera and by the
    parameters, of which `pars` (d,) are free."""

    first: int
    uv: np.ndarray
    valid: np.ndarray
    J_point: np.ndarray
    J_params: np.ndarray
    pars: np.ndarray


class Points(NamedTuple):
    """Points (T, 3) in the world on their way down: seen_from, where the camera is that each moves with; xyz and trial,
    half the chi^2 of both, the sums A (T, 3, 3) and b (T, 3) of both, how many images show them of both, damping (T,),
    and which still move."""

    seen_from: np.ndarray
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
def camera_points(seen, t0, R_cw, p_wc, points, X):
    """X (n, 3): each observation's point in its camera's frame; (0, 0, 1) where the track is left out."""
    o = seen.start[0]
    for i in range(len(seen.start) - 1):
        for n in range(seen.start[i], seen.start[i + 1]):
            t = seen.track[n]
            if t < 0:
                X[n - o, 0], X[n - o, 1], X[n - o, 2] = 0.0, 0.0, 1.0
            else:
                _in_camera(R_cw[i], p_wc[i], points[t - t0], X[n - o])


@njit(cache=True, nogil=True)
def _in_camera(R_cw, p_wc, point, x):
    a, b, c = point[0] - p_wc[0], point[1] - p_wc[1], point[2] - p_wc[2]
    for r in range(3):
        x[r] = R_cw[r, 0] * a + R_cw[r, 1] * b + R_cw[r, 2] * c


@njit(cache=True, nogil=True)
def moving_points(seen, t0, R_cw, p_wc, points, image, which, X):
    """Observations in use of points that still move: their image, which they are, and X their trial points in the
    camera's frame. Returns how many."""
    m = 0
    for i in range(len(seen.start) - 1):
        for n in range(seen.start[i], seen.start[i + 1]):
            if seen.track[n] >= 0 and seen.keep[n] and points.moves[seen.track[n] - t0]:
                image[m], which[m] = i, n
                _in_camera(R_cw[i], p_wc[i], points.trial[seen.track[n] - t0], X[m])
                m += 1
    return m


@njit(cache=True, nogil=True)
def add_rays(seen, t0, R_cw, p_wc, rays, valid, A, b):
    """Adds what each ray (n, 3) in its camera says of its point: A P = b is the point nearest to all rays."""
    o, d = seen.start[0], np.empty(3)
    for i in range(len(seen.start) - 1):
        for n in range(seen.start[i], seen.start[i + 1]):
            t = seen.track[n]
            if t < 0 or not (seen.keep[n] and valid[n - o]):
                continue
            for r in range(3):
                d[r] = 0.0
                for k in range(3):
                    d[r] += R_cw[i, k, r] * rays[n - o, k]
            along = d[0] * p_wc[i, 0] + d[1] * p_wc[i, 1] + d[2] * p_wc[i, 2]
            for r in range(3):
                b[t - t0, r] += p_wc[i, r] - along * d[r]
                A[t - t0, r, r] += 1.0
                for k in range(3):
                    A[t - t0, r, k] -= d[r] * d[k]


@njit(cache=True, nogil=True)
def add_to_points(seen, t0, R_cw, image, which, uv, valid, J_point, loss, points):
    """Adds one camera's observations `which` (m,), of images (m,), to the sums, with the true curvature of the loss,
    and costs of the trial points; uv, valid and J_point (m, ...): what the model makes of these."""
    J, e = np.empty((2, 3)), np.empty(2)
    for m in range(len(which)):
        n, R = which[m], R_cw[image[m]]
        t = seen.track[n] - t0
        if not valid[m]:
            continue
        for r in range(2):
            e[r] = uv[m, r] - seen.uv[n, r]
            for k in range(3):
                J[r, k] = J_point[m, r, 0] * R[0, k] + J_point[m, r, 1] * R[1, k] + J_point[m, r, 2] * R[2, k]
        variance = seen.sigma[n] * seen.sigma[n]
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
    """Takes trials that lowered the cost (all, at the `start`), then sets new ones; returns how many points still
    move. A point must not lower its cost by leaving an image. A last step is taken untried: cost and sums stay those of
    where it began."""
    M, d, axes, moving = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), 0
    for t in range(len(points.xyz)):
        if not points.moves[t]:
            continue
        stays = points.trial_shown[t] >= points.shown[t]
        if start or (stays and points.trial_cost[t] <= points.cost[t]):
            points.shown[t] = points.trial_shown[t]
            points.xyz[t], points.cost[t] = points.trial[t], points.trial_cost[t]
            points.A[t], points.b[t] = points.trial_A[t], points.trial_b[t]
            points.damping[t] *= 0.1
            if points.damping[t] < LEAST_DAMPING:
                points.damping[t] = 0.0
        else:
            points.damping[t] = max(10.0 * points.damping[t], FIRST_DAMPING)
        distance = _ray_axes(points.seen_from[t], points.xyz[t], axes)
        while points.damping[t] < MOST_DAMPING:
            if _step(axes, points.A[t], points.b[t], points.damping[t], distance > AT_END * FARTHEST_M, M, d):
                break
            points.damping[t] = max(10.0 * points.damping[t], FIRST_DAMPING)
        decrease = 0.0
        for a in range(3):
            for k in range(3):
                decrease -= 0.5 * d[a] * axes[a, k] * points.b[t, k]
        if points.damping[t] >= MOST_DAMPING:
            points.moves[t] = False
            continue
        _move(points.seen_from[t], axes, distance, d, points.trial[t])
        if points.damping[t] == 0.0 and decrease < SETTLED:
            points.xyz[t], points.moves[t] = points.trial[t], False
            continue
        moving += 1
        for a in range(3):
            points.trial_b[t, a] = 0.0
            for k in range(3):
                points.trial_A[t, a, k] = 0.0
        points.trial_cost[t], points.trial_shown[t] = 0.0, 0
    return moving


@njit(cache=True, nogil=True)
def _ray_axes(eye, point, axes):
    """axes (3, 3): rows of length one, the last from `eye` to `point`; returns how far it is."""
    x, y, z = point[0] - eye[0], point[1] - eye[1], point[2] - eye[2]
    distance = max(np.sqrt(x * x + y * y + z * z), 1e-9)
    axes[2, 0], axes[2, 1], axes[2, 2] = x / distance, y / distance, z / distance
    axes[:2] = tangents(axes[2])
    return distance


@njit(cache=True, nogil=True)
def _step(axes, A, b, damping, at_end, M, d):
    """Fills the step d (3,) along `axes`, not further out where the point is as far as it may be; False where the sums
    are not definite."""
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
    """M = axes A axes^T, d = -axes b."""
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
def _move(eye, axes, distance, d, point):
    """A step d along `axes` from where `point` is at `distance`. What is nearly linear is the direction in which it is
    seen, and the inverse of its distance: a step along the ray that long, to infinity and beyond, is an ordinary one
    there, and none leads behind the camera."""
    nearness = max((1.0 - d[2] / distance) / distance, 1.0 / FARTHEST_M)
    size = 0.0
    for a in range(3):
        point[a] = axes[2, a] + (d[0] * axes[0, a] + d[1] * axes[1, a]) / distance
        size += point[a] * point[a]
    for a in range(3):
        point[a] = eye[a] + point[a] / (np.sqrt(size) * nearness)


@njit(cache=True, nogil=True)
def held_back(own, gradient):
    """Twice what points of sums own (T, 3, 3) and gradient (T, 3) would still take off the cost if they could: those
    that an image's edge stops. It pulls at poses and calibration as it should, but is no gain of a step.

    A point at a camera's very centre has no inverse; what is not known of it promises nothing.
    """
    A, values, vectors, total = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), 0.0
    for t in range(len(own)):
        A[:] = own[t]
        eigen3(A, values, vectors)
        for k in range(3):
            if values[k] > NO_INVERSE * values[2]:
                along = 0.0
                for a in range(3):
                    along += vectors[a, k] * gradient[t, a]
                total += along * along / values[k]
    return total


@njit(cache=True, nogil=True)
def weighted_rows(i, n, X, seen, seeing, loss, R_cw, error, A):
    """Weighted rows of observation n, transposed: A (6 + d + 3 + 1, 2): camera pose, parameters, point, residual.
    Returns the square root of the weight over sigma, 0 where left out, and half the robust chi^2."""
    c, D = n - seeing.first, len(A) - 1
    for r in range(2):
        error[r] = seeing.uv[c, r] - seen.uv[n, r]
    if not (seen.keep[n] and seeing.valid[c]):
        return 0.0, 0.0
    square = (error[0] ** 2 + error[1] ** 2) / (seen.sigma[n] * seen.sigma[n])
    w, cost, curvature = weight(loss.kind, loss.scale, square)
    root = np.sqrt(w) / seen.sigma[n]
    x, y, z = X[c, 0], X[c, 1], X[c, 2]
    for r in range(2):
        a0, a1, a2 = root * seeing.J_point[c, r, 0], root * seeing.J_point[c, r, 1], root * seeing.J_point[c, r, 2]
        A[0, r], A[1, r], A[2, r] = a1 * z - a2 * y, a2 * x - a0 * z, a0 * y - a1 * x
        A[3, r], A[4, r], A[5, r] = -a0, -a1, -a2
        for q in range(len(seeing.pars)):
            A[6 + q, r] = root * seeing.J_params[c, r, seeing.pars[q]]
        for k in range(3):
            A[D - 3 + k, r] = a0 * R_cw[i, 0, k] + a1 * R_cw[i, 1, k] + a2 * R_cw[i, 2, k]
        A[D, r] = root * error[r]
    if loss.curved and curvature < 1.0:
        correct_curvature(A, D, 0, 1, error, np.sqrt(curvature))
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
def _add_feature(i, A, pair, t, T, n_chain, columns, features, by_pose):
    """One observation's rows A, of image i, into the sums of its feature; T (6, w): camera pose by keyframes and
    calibration parameters, columns (n, c + d) those of all images; by_pose (6,): work space."""
    D, n_b, side, block = len(A) - 1, features.side.shape[2] - 1, features.side[t], features.block[pair]
    n_c = T.shape[1] - n_chain
    for a in range(3):
        f0, f1 = A[D - 3 + a, 0], A[D - 3 + a, 1]
        for k in range(3):
            features.own[t, a, k] += f0 * A[D - 3 + k, 0] + f1 * A[D - 3 + k, 1]
        side[a, n_b] += f0 * A[D, 0] + f1 * A[D, 1]
        for q in range(n_c, columns.shape[1]):
            side[a, columns[i, q]] += f0 * A[6 + q - n_c, 0] + f1 * A[6 + q - n_c, 1]
        for d in range(6):
            by_pose[d] = f0 * A[d, 0] + f1 * A[d, 1]
            block[a, d] += by_pose[d]
        for j in range(n_c):
            if columns[i, j] >= 0:
                s = 0.0
                for d in range(6):
                    s += by_pose[d] * T[d, n_chain + j]
                side[a, columns[i, j]] += s


@njit(cache=True, nogil=True)
def _fill_pose(i, at, A_imu, T, features):
    """T (6, w): pose i of the camera by keyframes and calibration parameters; by keyframes also in `features`."""
    fill_chain(i, at, A_imu, T)
    for d in range(6):
        for j in range(KEYFRAME_DIM):
            features.pose[i, d, j] = T[d, j]
        for j in range(KEYFRAME_DIM if len(features.next_pose) else 0):
            features.next_pose[i, d, j] = T[d, KEYFRAME_DIM + j]


@njit(cache=True, nogil=True)
def accumulate(X, seen, base, at, columns, seeing, loss, sums, features, residual, root):
    """Residual (N, 2) and root (N,) of one camera's observations, and the normal equations where they are wanted. at:
    its poses in n images; columns (n, c + d): see `View`. Returns half the robust chi^2."""
    n_d, n_chain, width = len(seeing.pars), chain_width(at), chain_width(at) + columns.shape[1]
    A, G, error = np.zeros((10 + n_d, 2)), np.empty((7 + n_d, 7 + n_d)), np.empty(2)
    by_pose, most = np.empty(6), 0
    for i in range(len(seen.start) - 1):
        most = max(most, seen.start[i + 1] - seen.start[i])
    rows = np.empty((2 * most, 7 + n_d))
    A_imu, T, F = np.empty((6, 6)), np.empty((6, width - n_d)), np.empty((6, width + 1))
    total, D, wanted = 0.0, 9 + n_d, len(sums.diagonal) > 0
    for i in range(len(seen.start) - 1):
        if wanted:
            _fill_pose(i, at, A_imu, T, features)
        m = 0
        for n in range(seen.start[i], seen.start[i + 1]):
            t = seen.track[n] - base.track
            if seen.track[n] < 0:
                root[n], residual[n, 0], residual[n, 1] = 0.0, 0.0, 0.0
                continue
            root[n], cost = weighted_rows(i, n, X, seen, seeing, loss, at.R_sensor_world, error, A)
            residual[n, 0], residual[n, 1] = error[0], error[1]
            total += cost
            if not wanted or root[n] == 0.0:
                continue
            for r in range(2):
                for a in range(6 + n_d):
                    rows[m + r, a] = A[a, r]
                rows[m + r, 6 + n_d] = A[D, r]
            m += 2
            _add_feature(i, A, seen.pair[n] - base.pair, t, T, n_chain, columns, features, by_pose)
        if wanted:
            _gram(rows[:m], G)
            add_gram(seen.keyframe[i], n_chain, G, T, columns[i], F, sums)
    return total
