"""Compiled sums of the corner factor: from residuals and model Jacobians to the normal equations of a piece.

Images are counted from the first one of the piece, corners from the first of the recording.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.motion.sensor_pose import SensorPose, chain_width, fill_chain
from icalib.optim.robust_weights import correct_curvature, marginalise_shared, robust_weights, weight, whole_error
from icalib.optim.rows import add_gradients, add_gram


class Images(NamedTuple):
    """What was seen, each body of the target in an image taken as an image of its own: corners of image i are
    start[i]:start[i+1]; uv (N, 2), point (N,), keep (N,); keyframe (n,)."""

    start: np.ndarray
    uv: np.ndarray
    point: np.ndarray
    keep: np.ndarray
    keyframe: np.ndarray


class Noise(NamedTuple):
    """sigma (N,) px; the robust loss, where it bends, and whether the sums have its true curvature; the functions
    field (N, m) and precision (m,) of the common error."""

    sigma: np.ndarray
    loss: int
    scale: float
    curved: bool
    field: np.ndarray
    precision: np.ndarray


class Direct(NamedTuple):
    """What shows in the image beyond the pose: model parameters `pars` that are free, bloom along direction (N, 2) or
    (0, 2), the shape's basis (n_points, s, 3) in the world."""

    pars: np.ndarray
    bloom: float
    direction: np.ndarray
    basis: np.ndarray


class Motion(NamedTuple):
    """Poses of the camera at n images; where there are several bodies, the scene's rotation and each image's body (n,
    ...) in the world. columns (n, c + d): calibration columns, -1 where fixed: of the camera's pose, tilt of the scene
    2, pose of the body 6 or 0; then those of `Direct`."""

    camera: SensorPose
    R_world_scene: np.ndarray
    R_world_body: np.ndarray
    p_world_body: np.ndarray
    columns: np.ndarray


class Predicted(NamedTuple):
    """What the model makes of corners `first` and on: uv, valid, X in the camera, Jacobians by X and parameters."""

    first: int
    X: np.ndarray
    uv: np.ndarray
    valid: np.ndarray
    J_point: np.ndarray
    J_params: np.ndarray


class Found(NamedTuple):
    """What is left: residual (n, 2) and root (n,) of corners `first` and on, in single precision; shared (n, 2, m) by
    image."""

    first: int
    residual: np.ndarray
    root: np.ndarray
    shared: np.ndarray


@njit(cache=True, nogil=True)
def camera_points(i0, i1, start, point, R_cw, p_wc, world_points, X):
    """X (n, 3): the points of images i0..i1 in their camera's frame."""
    o = start[i0]
    for i in range(i0, i1):
        for n in range(start[i], start[i + 1]):
            q = point[n]
            a = world_points[q, 0] - p_wc[i, 0]
            b = world_points[q, 1] - p_wc[i, 1]
            c = world_points[q, 2] - p_wc[i, 2]
            for r in range(3):
                X[n - o, r] = R_cw[i, r, 0] * a + R_cw[i, r, 1] * b + R_cw[i, r, 2] * c


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _gram(A, D, n, out):
    """out (D, D) = A[:D, :n] A[:D, :n]^T, upper triangle mirrored. Sums may be reordered: they are vectorised, four at
    a time, so that each number loaded is used twice."""
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
def _predict_image(i, images, noise, direct, predicted, res, root, found):
    """Residuals res (n, 2), weights root (n,) and common error of image i; returns its half robust chi^2."""
    n0, n1, o, f0 = images.start[i], images.start[i + 1], predicted.first, images.start[i] - found.first
    ok = np.empty(n1 - n0, np.bool_)
    for k in range(n1 - n0):
        n = n0 + k
        ok[k] = images.keep[n] and predicted.valid[n - o]
        for r in range(2):
            res[k, r] = predicted.uv[n - o, r] - images.uv[n, r]
            if len(direct.direction):
                res[k, r] += direct.bloom * direct.direction[n, r]
    cost = robust_weights(
        res, ok, noise.field[n0:n1], noise.precision, noise.sigma[n0:n1], noise.loss, noise.scale, root, found.shared[i]
    )
    for k in range(n1 - n0):
        found.root[f0 + k] = root[k]
        for r in range(2):
            found.residual[f0 + k, r] = res[k, r]
    return cost


@njit(cache=True, nogil=True, inline="always")
def _recall_image(i, images, found, res, root):
    """What `_predict_image` left of image i."""
    n0, f0 = images.start[i], images.start[i] - found.first
    for k in range(images.start[i + 1] - n0):
        root[k] = found.root[f0 + k]
        for r in range(2):
            res[k, r] = found.residual[f0 + k, r]


@njit(cache=True, nogil=True)
def _fill_rows(i, images, noise, direct, motion, predicted, roots, error, A):
    """Weighted Jacobian of image i, transposed: A (D + 1, 2 n), u rows first; the last row the residual.

    With `curved`, where the loss bends the rows are scaled so that A^T A is the true curvature, A^T r the true
    gradient.
    """
    n0, n1 = images.start[i], images.start[i + 1]
    n, ns, n_pars = n1 - n0, direct.basis.shape[1], len(direct.pars)
    has_bloom = len(direct.direction) > 0
    D = 6 + n_pars + has_bloom + ns
    R = motion.camera.R_sensor_world[i]
    for k in range(n):
        c, root = n0 + k - predicted.first, roots[k]
        x, y, z = predicted.X[c, 0], predicted.X[c, 1], predicted.X[c, 2]
        basis = direct.basis[images.point[n0 + k]]
        for r in range(2):
            at = r * n + k
            a0, a1 = root * predicted.J_point[c, r, 0], root * predicted.J_point[c, r, 1]
            a2 = root * predicted.J_point[c, r, 2]
            A[0, at] = a1 * z - a2 * y
            A[1, at] = a2 * x - a0 * z
            A[2, at] = a0 * y - a1 * x
            A[3, at], A[4, at], A[5, at] = -a0, -a1, -a2
            for q in range(n_pars):
                A[6 + q, at] = root * predicted.J_params[c, r, direct.pars[q]]
            d = 6 + n_pars
            if has_bloom:
                A[d, at] = root * direct.direction[n0 + k, r]
                d += 1
            w0 = a0 * R[0, 0] + a1 * R[1, 0] + a2 * R[2, 0]
            w1 = a0 * R[0, 1] + a1 * R[1, 1] + a2 * R[2, 1]
            w2 = a0 * R[0, 2] + a1 * R[1, 2] + a2 * R[2, 2]
            for q in range(ns):
                A[d + q, at] = w0 * basis[q, 0] + w1 * basis[q, 1] + w2 * basis[q, 2]
            A[D, at] = root * error[k, r]
        if noise.curved and noise.loss > 0 and root > 0.0:
            sigma = noise.sigma[n0 + k]
            square = (error[k, 0] ** 2 + error[k, 1] ** 2) / (sigma * sigma)
            _, _, curvature = weight(noise.loss, noise.scale, square)
            if curvature < 1.0:
                correct_curvature(A, D, k, n, error[k], np.sqrt(curvature))


class _Work(NamedTuple):
    """For one image: rows A and their Gram matrix G; residual and error (n, 2), root (n,); its pose by that of the IMU,
    A_imu, and by keyframes and calibration parameters, T; F: see `add_gram`."""

    A: np.ndarray
    G: np.ndarray
    residual: np.ndarray
    error: np.ndarray
    root: np.ndarray
    A_imu: np.ndarray
    T: np.ndarray
    F: np.ndarray


@njit(cache=True, nogil=True)
def _work_space(images, direct, motion):
    most = 0
    for i in range(len(images.start) - 1):
        most = max(most, images.start[i + 1] - images.start[i])
    n_d = len(direct.pars) + (len(direct.direction) > 0) + direct.basis.shape[1]
    width, D = chain_width(motion.camera) + motion.columns.shape[1], 6 + n_d
    return _Work(
        np.empty((D + 1, 2 * most)), np.empty((D + 1, D + 1)), np.empty((most, 2)), np.empty((most, 2)), np.empty(most),
        np.empty((6, 6)), np.empty((6, width - n_d)), np.empty((6, width + 1)),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _fill_chain(i, motion, A_imu, T):
    """T (6, w): the camera's pose by keyframes and calibration parameters, in the order of `Motion.columns`."""
    fill_chain(i, motion.camera, A_imu, T)
    R_cw, p_wc = motion.camera.R_sensor_world[i], motion.camera.p_world_sensor[i]
    o = T.shape[1] - (8 if len(motion.R_world_body) else 2)
    for r in range(3):
        # Turning the board about world x (y) is turning the camera the other way about the board's origin.
        T[r, o], T[r, o + 1] = -R_cw[r, 0], -R_cw[r, 1]
        T[3 + r, o] = R_cw[r, 1] * p_wc[2] - R_cw[r, 2] * p_wc[1]
        T[3 + r, o + 1] = R_cw[r, 2] * p_wc[0] - R_cw[r, 0] * p_wc[2]
    if len(motion.R_world_body):
        _fill_body(i, motion, T)


@njit(cache=True, nogil=True, inline="always")
def _fill_body(i, motion, T):
    """The last 6 columns of T: moving the body is moving the camera the other way, turning about the body's origin."""
    R_cw, R_wb, o = motion.camera.R_sensor_world[i], motion.R_world_body[i], T.shape[1] - 6
    away = so3.hat(motion.camera.p_world_sensor[i] - motion.p_world_body[i])
    for r in range(3):
        for j in range(3):
            for k in range(3):
                T[r, o + j] -= R_cw[r, k] * R_wb[k, j]
                T[3 + r, o + 3 + j] -= R_cw[r, k] * motion.R_world_scene[k, j]
                for m in range(3):
                    T[3 + r, o + j] += R_cw[r, k] * away[k, m] * R_wb[m, j]


@njit(cache=True, nogil=True)
def accumulate(i0, i1, images, noise, direct, motion, predicted, sums, found):
    """Images i0..i1: residuals, weights and common errors out, and the normal equations where they are wanted.

    Returns half the robust chi^2.
    """
    work, total = _work_space(images, direct, motion), 0.0
    A, G, T, D, n_chain = work.A, work.G, work.T, len(work.G) - 1, chain_width(motion.camera)
    for i in range(i0, i1):
        n0, n1 = images.start[i], images.start[i + 1]
        n = n1 - n0
        res, root = work.residual[:n], work.root[:n]
        total += _predict_image(i, images, noise, direct, predicted, res, root, found)
        if len(sums.diagonal) == 0:
            continue
        whole_error(res, noise.field[n0:n1], found.shared[i], work.error)
        _fill_rows(i, images, noise, direct, motion, predicted, root, work.error, A)
        _gram(A, D + 1, 2 * n, G)
        if len(noise.precision):
            marginalise_shared(A, D, n, root, noise.field[n0:n1], noise.precision, G)
        _fill_chain(i, motion, work.A_imu, T)
        add_gram(images.keyframe[i] - sums.first, n_chain, G, T, motion.columns[i], work.F, sums)
    return total


@njit(cache=True, nogil=True)
def accumulate_clusters(i0, i1, cluster, n_clusters, column, images, noise, direct, motion, predicted, sums, found):
    """Gradients of images i0..i1 by cluster of corners, into columns `column` and on of side and calibration
    parameters."""
    work = _work_space(images, direct, motion)
    A, T, D, n_chain = work.A, work.T, len(work.G) - 1, chain_width(motion.camera)
    G = np.empty((D, n_clusters))
    for i in range(i0, i1):
        n0, n1 = images.start[i], images.start[i + 1]
        n = n1 - n0
        res, root = work.residual[:n], work.root[:n]
        _recall_image(i, images, found, res, root)
        whole_error(res, noise.field[n0:n1], found.shared[i], work.error)
        _fill_rows(i, images, noise, direct, motion, predicted, root, work.error, A)
        for d in range(D):
            for g in range(n_clusters):
                G[d, g] = 0.0
            for k in range(n):
                G[d, cluster[n0 + k]] += A[d, k] * A[D, k] + A[d, n + k] * A[D, n + k]
        _fill_chain(i, motion, work.A_imu, T)
        add_gradients(images.keyframe[i] - sums.first, n_chain, G, T, motion.columns[i], column, sums)
