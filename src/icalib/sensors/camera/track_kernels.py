"""Compiled sums of the feature factor: observations of tracks, and the normal equations of a piece.

Images are those of one camera in a piece. A pair is a track with one of its images. Indices of observations, tracks and
pairs count from the first of all recordings; `PieceStart` has the first ones of the piece. J_rows are transposed
Jacobians, with one column for each image axis.

Compiled gradients of clusters of track observations: by points, camera poses and lens parameters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.blas import subtract_gram
from icalib.geometry.small import eigen3
from icalib.motion.sensor_pose import chain_width, fill_chain
from icalib.optim.rows import add_gradients, add_gram, correct_curvature, weight
from icalib.optim.state import KEYFRAME_DIM

MIN_EIGENVALUE_RATIO = 1e-15  # to the largest eigenvalue; a smaller eigenvalue is rounding noise, and counts as zero


class TrackObservations(NamedTuple):
    """Observations of tracks by one camera in n images.

    start (n + 1,): observations of image i are start[i]:start[i+1]; uv (N, 2) px; keep (N,) bool: observations in use;
    track, pair (N,): indices, -1 if the track is left out; keyframe (n,): index counted from the first of the piece;
    sigma (N,) px per axis."""

    start: np.ndarray
    uv: np.ndarray
    keep: np.ndarray
    track: np.ndarray
    pair: np.ndarray
    keyframe: np.ndarray
    sigma: np.ndarray


class PieceStart(NamedTuple):
    """Indices of the first track and of the first pair of a piece."""

    track: int
    pair: int


class TrackProjection(NamedTuple):
    """Projection of the n observations from number `first` on.

    uv (n, 2) px; valid (n,) bool, within the range of the model; J_point (n, 2, 3) px/m, J_params (n, 2, P): Jacobians
    of uv by the point in the camera frame and by the lens parameters; pars (d,): indices of the free parameters.
    share (n, knots), by_readout (n or 0, 3): see `CornerProjection`. R_cam_world: of each image, or with a rolling
    shutter of each observation."""

    first: int
    uv: np.ndarray
    valid: np.ndarray
    J_point: np.ndarray
    J_params: np.ndarray
    pars: np.ndarray
    share: np.ndarray
    by_readout: np.ndarray
    R_cam_world: np.ndarray


@njit(cache=True, nogil=True)
def camera_points(observed, t0, R_cam_world, p_world_cam, points, X):
    """Writes the point of each observation in the camera frame into X (n, 3) m; (0, 0, 1) if its track is left out.

    points (T, 3) m: points of the tracks from number t0 on, in the world frame."""
    o = observed.start[0]
    for i in range(len(observed.start) - 1):
        for n in range(observed.start[i], observed.start[i + 1]):
            t = observed.track[n]
            if t < 0:
                X[n - o, 0], X[n - o, 1], X[n - o, 2] = 0.0, 0.0, 1.0
            else:
                in_camera(R_cam_world[i], p_world_cam[i], points[t - t0], X[n - o])


@njit(cache=True, nogil=True)
def in_camera(R_cam_world, p_world_cam, point, x):
    """Transforms `point` (3,) m from the world frame to the camera frame, into x (3,) m."""
    a, b, c = point[0] - p_world_cam[0], point[1] - p_world_cam[1], point[2] - p_world_cam[2]
    for r in range(3):
        x[r] = R_cam_world[r, 0] * a + R_cam_world[r, 1] * b + R_cam_world[r, 2] * c


@njit(cache=True, nogil=True)
def predicted_decrease(A_points, gradient):
    """Twice the decrease of cost that Gauss-Newton steps of the points would predict: sum of g^T A^-1 g over points.

    A_points (T, 3, 3), gradient (T, 3): normal equations A and g of the points. The sum is above zero if the border of
    an image stops a point before its minimum; the solver must not count this decrease as gain of a step. Directions
    without information, as for a point at the camera's centre, add nothing.
    """
    A, values, vectors, total = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), 0.0
    for t in range(len(A_points)):
        A[:] = A_points[t]
        eigen3(A, values, vectors)
        for k in range(3):
            if values[k] > MIN_EIGENVALUE_RATIO * values[2]:
                along = 0.0
                for a in range(3):
                    along += vectors[a, k] * gradient[t, a]
                total += along * along / values[k]
    return total


@njit(cache=True, nogil=True)
def weighted_rows(i, n, X, observed, projection, loss, error, J_rows):
    """Writes the transposed weighted Jacobian of observation n in image i into J_rows (6 knots + d + 3 + 1, 2).

    Its rows: camera pose of each knot, d free parameters of lens and readout, point; last, the weighted residual.
    Also writes error (2,) px, predicted - measured. Returns root [1/px], the square root of the robust weight over
    sigma, and half the robust chi^2; both are 0 if the observation is not in use."""
    c, D, knots = n - projection.first, len(J_rows) - 1, projection.share.shape[1]
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
        for q in range(knots):
            share, o = projection.share[c, q], 6 * q
            J_rows[o, r], J_rows[o + 1, r] = share * (a1 * z - a2 * y), share * (a2 * x - a0 * z)
            J_rows[o + 2, r] = share * (a0 * y - a1 * x)
            J_rows[o + 3, r], J_rows[o + 4, r], J_rows[o + 5, r] = -share * a0, -share * a1, -share * a2
        for q in range(len(projection.pars)):
            J_rows[6 * knots + q, r] = root * projection.J_params[c, r, projection.pars[q]]
        if knots > 1:
            by = projection.by_readout[c]
            J_rows[D - 4, r] = a0 * by[0] + a1 * by[1] + a2 * by[2]
        R = projection.R_cam_world[c if knots > 1 else i]
        for k in range(3):
            J_rows[D - 3 + k, r] = a0 * R[0, k] + a1 * R[1, k] + a2 * R[2, k]
        J_rows[D, r] = root * error[r]
    if loss.curved and curvature < 1.0:
        correct_curvature(J_rows, D, 0, 1, error, np.sqrt(curvature))
    return root, cost


@njit(cache=True, nogil=True)
def _gram(rows, G):
    """Writes the Gram matrix rows^T rows into G."""
    G[:] = 0.0
    subtract_gram(rows, G)
    for a in range(len(G)):
        for b in range(a, len(G)):
            G[a, b] = G[b, a] = -G[a, b]


@njit(cache=True, nogil=True)
def _add_feature(i, J_rows, pair, t, J_chain, n_chain, columns, features, by_pose):
    """Adds one observation of image i, with Jacobian J_rows, to the sums of its track t in `features`.

    J_chain (p, w): Jacobian of the camera poses by n_chain keyframe parameters and by calibration parameters; columns
    (n, c + d): see `CameraImages`; by_pose (p,): workspace."""
    D, n_b, side, block = len(J_rows) - 1, features.side.shape[2] - 1, features.side[t], features.block[pair]
    n_c, p = J_chain.shape[1] - n_chain, len(J_chain)
    for a in range(3):
        f0, f1 = J_rows[D - 3 + a, 0], J_rows[D - 3 + a, 1]
        for k in range(3):
            features.diagonal[t, a, k] += f0 * J_rows[D - 3 + k, 0] + f1 * J_rows[D - 3 + k, 1]
        side[a, n_b] += f0 * J_rows[D, 0] + f1 * J_rows[D, 1]
        for q in range(n_c, columns.shape[1]):
            if columns[i, q] >= 0:
                side[a, columns[i, q]] += f0 * J_rows[p + q - n_c, 0] + f1 * J_rows[p + q - n_c, 1]
        for d in range(p):
            by_pose[d] = f0 * J_rows[d, 0] + f1 * J_rows[d, 1]
            block[a, d] += by_pose[d]
        for j in range(n_c):
            if columns[i, j] >= 0:
                s = 0.0
                for d in range(p):
                    s += by_pose[d] * J_chain[d, n_chain + j]
                side[a, columns[i, j]] += s


@njit(cache=True, nogil=True)
def _fill_chains(i, poses, J_imu, J_chain):
    """Writes the Jacobians of the camera poses of image i, one for each knot, by keyframes and calibration parameters
    into J_chain (6 knots, w)."""
    knots = len(J_chain) // 6
    for k in range(knots):
        fill_chain(i * knots + k, poses, J_imu, J_chain[6 * k : 6 * k + 6])


@njit(cache=True, nogil=True)
def _fill_poses(i, poses, J_imu, J_chain, features):
    """Fills J_chain as `_fill_chains`, and copies its keyframe columns to `features`."""
    _fill_chains(i, poses, J_imu, J_chain)
    for d in range(len(J_chain)):
        for j in range(KEYFRAME_DIM):
            features.pose[i, d, j] = J_chain[d, j]
        for j in range(KEYFRAME_DIM if len(features.next_pose) else 0):
            features.next_pose[i, d, j] = J_chain[d, KEYFRAME_DIM + j]


@njit(cache=True, nogil=True)
def _most_observations(observed):
    """Number of observations in the image with most."""
    most = 0
    for i in range(len(observed.start) - 1):
        most = max(most, observed.start[i + 1] - observed.start[i])
    return most


@njit(cache=True, nogil=True)
def accumulate(X, observed, base, poses, columns, projection, loss, sums, features, residual, root):
    """Writes residual (N, 2) px and root (N,) 1/px of the observations by one camera.

    Adds their normal equations to `sums` and `features`, unless the arrays of `sums` are empty. X (n, 3) m: points in
    the camera frame; poses: camera poses; columns (n, c + d): see `CameraImages`. Returns half the robust chi^2."""
    knots, n_chain, width = projection.share.shape[1], chain_width(poses), chain_width(poses) + columns.shape[1]
    p, n_d = 6 * knots, len(projection.pars) + (knots > 1)
    J_rows, G, error = np.zeros((p + n_d + 4, 2)), np.empty((p + n_d + 1, p + n_d + 1)), np.empty(2)
    by_pose, most = np.empty(p), _most_observations(observed)
    rows = np.empty((2 * most, p + n_d + 1))
    J_imu, J_chain, F = np.empty((6, 6)), np.empty((p, width - n_d)), np.empty((p, width + 1))
    total, D, wanted = 0.0, p + n_d + 3, len(sums.diagonal) > 0
    for i in range(len(observed.start) - 1):
        if wanted:
            _fill_poses(i, poses, J_imu, J_chain, features)
        m = 0
        for n in range(observed.start[i], observed.start[i + 1]):
            t = observed.track[n] - base.track
            if observed.track[n] < 0:
                root[n], residual[n, 0], residual[n, 1] = 0.0, 0.0, 0.0
                continue
            root[n], cost = weighted_rows(i, n, X, observed, projection, loss, error, J_rows)
            residual[n, 0], residual[n, 1] = error[0], error[1]
            total += cost
            if not wanted or root[n] == 0.0:
                continue
            for r in range(2):
                for a in range(p + n_d):
                    rows[m + r, a] = J_rows[a, r]
                rows[m + r, p + n_d] = J_rows[D, r]
            m += 2
            _add_feature(i, J_rows, observed.pair[n] - base.pair, t, J_chain, n_chain, columns, features, by_pose)
        if wanted:
            _gram(rows[:m], G)
            add_gram(observed.keyframe[i], n_chain, G, J_chain, columns[i], F, sums)
    return total


@njit(cache=True, nogil=True)
def accumulate_clusters(X, observed, base, poses, columns, projection, loss, cluster, n_clusters, column, sums, side):
    """Adds the gradient of each cluster of one camera's observations to the columns from `column` on.

    Gradients by poses and calibration are added to `sums`, gradients by points to side (T, 3, columns). X (n, 3) m:
    points in the camera frame; cluster (N,): index of the cluster of each observation, from 0 to n_clusters - 1."""
    knots = projection.share.shape[1]
    p, n_d = 6 * knots, len(projection.pars) + (knots > 1)
    J_rows, G, error, D = np.zeros((p + n_d + 4, 2)), np.empty((p + n_d, n_clusters)), np.empty(2), p + n_d + 3
    J_imu, J_chain = np.empty((6, 6)), np.empty((p, chain_width(poses) + columns.shape[1] - n_d))
    for i in range(len(observed.start) - 1):
        G[:] = 0.0
        for n in range(observed.start[i], observed.start[i + 1]):
            if observed.track[n] < 0:
                continue
            root, _ = weighted_rows(i, n, X, observed, projection, loss, error, J_rows)
            if root == 0.0:
                continue
            for d in range(p + n_d):
                G[d, cluster[n]] += J_rows[d, 0] * J_rows[D, 0] + J_rows[d, 1] * J_rows[D, 1]
            for a in range(3):
                by_point = J_rows[D - 3 + a, 0] * J_rows[D, 0] + J_rows[D - 3 + a, 1] * J_rows[D, 1]
                side[observed.track[n] - base.track, a, column + cluster[n]] += by_point
        _fill_chains(i, poses, J_imu, J_chain)
        add_gradients(observed.keyframe[i], chain_width(poses), G, J_chain, columns[i], column, sums)
