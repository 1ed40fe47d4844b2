"""Compiled sums of the corner factor: from residuals and model Jacobians to the normal equations of a piece.

Indices of views count from the first view of the kernel's arguments, indices of corners from the first of the stream.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.motion.sensor_pose import SensorPose, chain_width, fill_chain
from icalib.optim.rows import (
    add_common_error,
    add_gradients,
    add_gram,
    correct_curvature,
    marginalise_gradients,
    marginalise_shared,
    robust_weights,
    weight,
)


class ViewCorners(NamedTuple):
    """Corners of n views; a view is one body of the target in one image.

    start (n + 1,): corners of view i are start[i]:start[i+1]; uv (N, 2) px; point (N,) index of the target's point;
    keep (N,) bool, corners in use; keyframe (n,) index."""

    start: np.ndarray
    uv: np.ndarray
    point: np.ndarray
    keep: np.ndarray
    keyframe: np.ndarray


class Noise(NamedTuple):
    """Noise of all corners, and the robust loss.

    sigma (N,) px per axis; loss: number in `LOSSES`; scale: its threshold in sigma; curved: whether the normal
    equations have the true curvature of the loss. field (N, 2, m): change of each corner per unit of each coefficient
    of the error that a view shares; precision (m,): prior information of these coefficients."""

    sigma: np.ndarray
    loss: int
    scale: float
    curved: bool
    field: np.ndarray
    precision: np.ndarray


class DirectParameters(NamedTuple):
    """Parameters that act on the image directly, not through the pose of the camera: lens, bloom, readout, shape of
    bodies.

    pars: indices of the free parameters of the camera model. bloom: shift [px] along direction (N, 2), which is (0, 2)
    without bloom. basis (n_points, s, 3) m: displacement of points in the world per unit of each of the s shape and
    size parameters of a body."""

    pars: np.ndarray
    bloom: float
    direction: np.ndarray
    basis: np.ndarray


class ViewPoses(NamedTuple):
    """Poses of the camera and of the target in n views. knots: number of poses of the camera in each view, see
    `CornerProjection.share`; that of view i and knot k has index i * knots + k.

    R_world_body (n, 3, 3), p_world_body (n, 3) m: pose of each view's body; empty if the target is one body. columns
    (n, c + d): indices of calibration parameters, -1 where fixed. The first c are those of the camera's pose, the
    scene's tilt (2) and the body's pose (6, or 0 for one body). The last d are those of `DirectParameters`."""

    camera: SensorPose
    knots: int
    R_world_scene: np.ndarray
    R_world_body: np.ndarray
    p_world_body: np.ndarray
    columns: np.ndarray


class CornerProjection(NamedTuple):
    """Projection of the n corners from number `first` on.

    X (n, 3) m: points in the camera frame; uv (n, 2) px; valid (n,) bool, within the range of the model; J_point
    (n, 2, 3) px/m and J_params (n, 2, P): Jacobians of uv, empty if no normal equations are wanted.

    share (n, knots): the camera pose of a corner changes as the sum of its view's poses with these weights, which are 1
    with a global shutter. by_readout (n, 3) m/s: Jacobian of X by the readout time; (0, 3) with a global shutter."""

    first: int
    X: np.ndarray
    uv: np.ndarray
    valid: np.ndarray
    J_point: np.ndarray
    J_params: np.ndarray
    share: np.ndarray
    by_readout: np.ndarray


class CornerResidualArrays(NamedTuple):
    """Output arrays for the corners from number `first` on.

    residual (n, 2) px: predicted - measured, without the common error; root (n,) 1/px: square root of the robust
    weight, over sigma; shared (v, m): coefficients of the common error of each of v views."""

    first: int
    residual: np.ndarray
    root: np.ndarray
    shared: np.ndarray


@njit(cache=True, nogil=True)
def camera_points(i0, i1, start, point, R_cam_world, p_world_cam, world_points, X):
    """Writes the points of the corners of views i0..i1 in the camera frame into X (n, 3) m.

    world_points (n_points, 3) m: points of the target in the world frame."""
    o = start[i0]
    for i in range(i0, i1):
        for n in range(start[i], start[i + 1]):
            q = point[n]
            a = world_points[q, 0] - p_world_cam[i, 0]
            b = world_points[q, 1] - p_world_cam[i, 1]
            c = world_points[q, 2] - p_world_cam[i, 2]
            for r in range(3):
                X[n - o, r] = R_cam_world[i, r, 0] * a + R_cam_world[i, r, 1] * b + R_cam_world[i, r, 2] * c


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _gram(A, D, n, out):
    """Writes the Gram matrix A[:D, :n] A[:D, :n]^T into out (D, D).

    Blocks of 2 x 2 sums use each loaded number twice. The compiler may reorder sums to vectorise them."""
    for i in range(0, D, 2):
        i1 = min(i + 1, D - 1)
        for j in range(i, D, 2):
            j1 = min(j + 1, D - 1)
            s, t, u, v = 0.0, 0.0, 0.0, 0.0
            for k in range(n):
                a, b, c, d = A[i, k], A[i1, k], A[j, k], A[j1, k]
                s += a * c
                t += a * d
                u += b * c
                v += b * d
            out[i, j], out[i, j1], out[i1, j], out[i1, j1] = s, t, u, v
            out[j, i], out[j1, i], out[j, i1], out[j1, i1] = s, t, u, v


@njit(cache=True, nogil=True, inline="always")
def _predict_view(i, corners, noise, direct, projection, residual, root, kept):
    """Writes residual (n, 2) px and root (n,) 1/px of view i, and copies both with the common error into `kept`.

    Returns half the robust chi^2 of the view."""
    n0, n1, o, f0 = corners.start[i], corners.start[i + 1], projection.first, corners.start[i] - kept.first
    ok = np.empty(n1 - n0, np.bool_)
    for k in range(n1 - n0):
        n = n0 + k
        ok[k] = corners.keep[n] and projection.valid[n - o]
        for r in range(2):
            residual[k, r] = projection.uv[n - o, r] - corners.uv[n, r]
            if len(direct.direction):
                residual[k, r] += direct.bloom * direct.direction[n, r]
    field, sigma = noise.field[n0:n1], noise.sigma[n0:n1]
    cost = robust_weights(residual, ok, field, noise.precision, sigma, noise.loss, noise.scale, root, kept.shared[i])
    for k in range(n1 - n0):
        kept.root[f0 + k] = root[k]
        for r in range(2):
            kept.residual[f0 + k, r] = residual[k, r]
    return cost


@njit(cache=True, nogil=True, inline="always")
def _recall_view(i, corners, kept, residual, root):
    """Copies the residuals and weights of view i, which `_predict_view` stored in `kept`, into residual and root."""
    n0, f0 = corners.start[i], corners.start[i] - kept.first
    for k in range(corners.start[i + 1] - n0):
        root[k] = kept.root[f0 + k]
        for r in range(2):
            residual[k, r] = kept.residual[f0 + k, r]


@njit(cache=True, nogil=True)
def _fill_rows(i, corners, noise, direct, poses, projection, roots, error, J_rows, J_shared):
    """Writes the transposed weighted Jacobian of view i into J_rows (D + 1, 2 n), and that by the common error into
    J_shared (m + 1, 2 n).

    Rows: camera pose (6) of each knot, free model parameters, bloom, readout time, shape and size of the body; last, in
    both, the weighted error."""
    n0, n = corners.start[i], corners.start[i + 1] - corners.start[i]
    ns, n_pars, has_bloom = direct.basis.shape[1], len(direct.pars), len(direct.direction) > 0
    rolls, knots, by_pose = poses.knots > 1, poses.knots, np.empty(6)
    D = 6 * knots + n_pars + has_bloom + rolls + ns
    for k in range(n):
        c, root = n0 + k - projection.first, roots[k]
        x, y, z = projection.X[c, 0], projection.X[c, 1], projection.X[c, 2]
        basis = direct.basis[corners.point[n0 + k]]
        for r in range(2):
            at = r * n + k
            a0, a1 = root * projection.J_point[c, r, 0], root * projection.J_point[c, r, 1]
            a2 = root * projection.J_point[c, r, 2]
            by_pose[0], by_pose[1], by_pose[2] = a1 * z - a2 * y, a2 * x - a0 * z, a0 * y - a1 * x
            by_pose[3], by_pose[4], by_pose[5] = -a0, -a1, -a2
            for q in range(knots):
                for j in range(6):
                    J_rows[6 * q + j, at] = projection.share[c, q] * by_pose[j]
            d = 6 * knots
            for q in range(n_pars):
                J_rows[d + q, at] = root * projection.J_params[c, r, direct.pars[q]]
            d += n_pars
            if has_bloom:
                J_rows[d, at] = root * direct.direction[n0 + k, r]
                d += 1
            if rolls:
                by = projection.by_readout[c]
                J_rows[d, at] = a0 * by[0] + a1 * by[1] + a2 * by[2]
                d += 1
            for q in range(ns):
                J_rows[d + q, at] = 0.0
            for m in range(knots if ns else 0):
                R, share = poses.camera.R_sensor_world[i * knots + m], projection.share[c, m]
                w0 = share * (a0 * R[0, 0] + a1 * R[1, 0] + a2 * R[2, 0])
                w1 = share * (a0 * R[0, 1] + a1 * R[1, 1] + a2 * R[2, 1])
                w2 = share * (a0 * R[0, 2] + a1 * R[1, 2] + a2 * R[2, 2])
                for q in range(ns):
                    J_rows[d + q, at] += w0 * basis[q, 0] + w1 * basis[q, 1] + w2 * basis[q, 2]
            J_rows[D, at] = root * error[k, r]
            for q in range(len(noise.precision)):
                J_shared[q, at] = root * noise.field[n0 + k, r, q]
            J_shared[len(noise.precision), at] = root * error[k, r]
    if noise.curved and noise.loss > 0:
        _bend_rows(n0, n, noise, roots, error, D, J_rows)
        _bend_rows(n0, n, noise, roots, error, len(noise.precision), J_shared)


@njit(cache=True, nogil=True)
def _bend_rows(n0, n, noise, roots, error, D, J_rows):
    """Rescales the columns of J_rows of corners beyond the threshold of the loss, for the n corners from n0 on.

    J_rows J_rows^T then has the true curvature of the robust loss; the gradient is unchanged (Triggs et al. 2000)."""
    for k in range(n):
        if roots[k] > 0.0:
            sigma = noise.sigma[n0 + k]
            square = (error[k, 0] ** 2 + error[k, 1] ** 2) / (sigma * sigma)
            _, _, curvature = weight(noise.loss, noise.scale, square)
            if curvature < 1.0:
                correct_curvature(J_rows, D, k, n, error[k], np.sqrt(curvature))


class _Workspace(NamedTuple):
    """Reused arrays for one view of at most n corners.

    J_rows (D + 1, 2 n), J_shared (m + 1, 2 n): weighted Jacobians, see `_fill_rows`; G (D + 1, D + 1): Gram matrix of
    J_rows; residual (n, 2) px, error (n, 2) px: with the common error; root (n,) 1/px. J_imu (6, 6): Jacobian
    of a camera pose by the IMU pose; J_chain (6 knots, w): of all poses of the view by keyframes and calibration
    parameters; F: see `add_gram`."""

    J_rows: np.ndarray
    J_shared: np.ndarray
    G: np.ndarray
    residual: np.ndarray
    error: np.ndarray
    root: np.ndarray
    J_imu: np.ndarray
    J_chain: np.ndarray
    F: np.ndarray


@njit(cache=True, nogil=True)
def _workspace(corners, noise, direct, poses):
    """A `_Workspace` for the view with most corners."""
    most = 0
    for i in range(len(corners.start) - 1):
        most = max(most, corners.start[i + 1] - corners.start[i])
    n_d = len(direct.pars) + (len(direct.direction) > 0) + (poses.knots > 1) + direct.basis.shape[1]
    n_pose = 6 * poses.knots
    width, D = chain_width(poses.camera) + poses.columns.shape[1], n_pose + n_d
    return _Workspace(
        np.empty((D + 1, 2 * most)), np.empty((len(noise.precision) + 1, 2 * most)), np.empty((D + 1, D + 1)),
        np.empty((most, 2)), np.empty((most, 2)), np.empty(most),
        np.empty((6, 6)), np.empty((n_pose, width - n_d)), np.empty((n_pose, width + 1)),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _fill_pose_chains(i, poses, J_imu, J_chain):
    """Writes the Jacobians of the camera poses of view i into J_chain (6 knots, w)."""
    for k in range(poses.knots):
        _fill_pose_chain(i, i * poses.knots + k, poses, J_imu, J_chain[6 * k : 6 * k + 6])


@njit(cache=True, nogil=True)
def _fill_pose_chain(i, at, poses, J_imu, J_chain):
    """Writes the Jacobian of the camera pose number `at`, of view i, into J_chain (6, w): by keyframes, then by the c
    `ViewPoses.columns`."""
    fill_chain(at, poses.camera, J_imu, J_chain)
    R_cam_world, p_world_cam = poses.camera.R_sensor_world[at], poses.camera.p_world_sensor[at]
    o = J_chain.shape[1] - (8 if len(poses.R_world_body) else 2)
    for r in range(3):
        # Tilting the scene about world x (y) has the same effect as rotating the camera by the opposite angle about
        # the scene's origin.
        J_chain[r, o], J_chain[r, o + 1] = -R_cam_world[r, 0], -R_cam_world[r, 1]
        J_chain[3 + r, o] = R_cam_world[r, 1] * p_world_cam[2] - R_cam_world[r, 2] * p_world_cam[1]
        J_chain[3 + r, o + 1] = R_cam_world[r, 2] * p_world_cam[0] - R_cam_world[r, 0] * p_world_cam[2]
    if len(poses.R_world_body):
        _fill_body(i, at, poses, J_chain)


@njit(cache=True, nogil=True, inline="always")
def _fill_body(i, at, poses, J_chain):
    """Writes the Jacobian of the camera pose number `at` by the body pose of view i into the last 6 columns of J_chain.

    Moving the body by d has the same effect as moving the camera by the inverse of d about the body's origin."""
    R_cam_world, R_world_body, o = poses.camera.R_sensor_world[at], poses.R_world_body[i], J_chain.shape[1] - 6
    away = so3.hat(poses.camera.p_world_sensor[at] - poses.p_world_body[i])
    for r in range(3):
        for j in range(3):
            for k in range(3):
                J_chain[r, o + j] -= R_cam_world[r, k] * R_world_body[k, j]
                J_chain[3 + r, o + 3 + j] -= R_cam_world[r, k] * poses.R_world_scene[k, j]
                for m in range(3):
                    J_chain[3 + r, o + j] += R_cam_world[r, k] * away[k, m] * R_world_body[m, j]


@njit(cache=True, nogil=True)
def accumulate(i0, i1, corners, noise, direct, poses, projection, sums, kept):
    """Writes residuals, weights and common errors of views i0..i1 into `kept`.

    Adds their normal equations to `sums`, unless its arrays are empty. Returns half the robust chi^2.
    """
    work, total = _workspace(corners, noise, direct, poses), 0.0
    J_rows, G, J_chain, D, n_chain = work.J_rows, work.G, work.J_chain, len(work.G) - 1, chain_width(poses.camera)
    for i in range(i0, i1):
        n0, n1 = corners.start[i], corners.start[i + 1]
        n = n1 - n0
        residual, root = work.residual[:n], work.root[:n]
        total += _predict_view(i, corners, noise, direct, projection, residual, root, kept)
        if len(sums.diagonal) == 0:
            continue
        add_common_error(residual, noise.field[n0:n1], kept.shared[i], work.error)
        _fill_rows(i, corners, noise, direct, poses, projection, root, work.error, J_rows, work.J_shared)
        _gram(J_rows, D + 1, 2 * n, G)
        if len(noise.precision):
            marginalise_shared(J_rows, D, n, work.J_shared, noise.precision, G)
        _fill_pose_chains(i, poses, work.J_imu, J_chain)
        add_gram(corners.keyframe[i] - sums.first, n_chain, G, J_chain, poses.columns[i], work.F, sums)
    return total


@njit(cache=True, nogil=True)
def accumulate_clusters(i0, i1, cluster, n_clusters, column, corners, noise, direct, poses, projection, sums, kept):
    """Adds the gradient of each cluster of corners in views i0..i1 to the columns from `column` on of `sums`.

    cluster (N,): index of each corner's cluster, from 0 to n_clusters - 1. kept: residuals and weights to use."""
    work = _workspace(corners, noise, direct, poses)
    J_rows, J_chain, D, n_chain = work.J_rows, work.J_chain, len(work.G) - 1, chain_width(poses.camera)
    G = np.empty((D, n_clusters))
    for i in range(i0, i1):
        n0, n1 = corners.start[i], corners.start[i + 1]
        n = n1 - n0
        residual, root = work.residual[:n], work.root[:n]
        _recall_view(i, corners, kept, residual, root)
        add_common_error(residual, noise.field[n0:n1], kept.shared[i], work.error)
        _fill_rows(i, corners, noise, direct, poses, projection, root, work.error, J_rows, work.J_shared)
        for d in range(D):
            for g in range(n_clusters):
                G[d, g] = 0.0
            for k in range(n):
                G[d, cluster[n0 + k]] += J_rows[d, k] * J_rows[D, k] + J_rows[d, n + k] * J_rows[D, n + k]
        if len(noise.precision):
            marginalise_gradients(J_rows, D, n, work.J_shared, noise.precision, cluster[n0:n1], G)
        _fill_pose_chains(i, poses, work.J_imu, J_chain)
        add_gradients(corners.keyframe[i] - sums.first, n_chain, G, J_chain, poses.columns[i], column, sums)
