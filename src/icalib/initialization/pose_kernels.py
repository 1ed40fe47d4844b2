"""Pose of a planar board from rays, compiled: homography, both planar solutions, robust Gauss-Newton."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numba import njit

from icalib.geometry import so3

_INVERSE_ITERATIONS = 12
_GAUSS_NEWTON_STEPS = 8
_STEP_TOLERANCE = 1e-5  # rad, and parts of the board's distance
_MIN_CORNERS = 4
_FLAT = 1e-3  # squared aspect below which the corners lie on a line
_RIVAL = 1.5  # a second solution with less than this many times the error is as good as the first
_RIVAL_COSINE = 0.995  # of the angle between the two normals, above which they are the same solution


@njit(cache=True, nogil=True)
def cholesky(A):
    """In place, lower triangle: A = L L^T. False where A is not positive definite."""
    n = len(A)
    for j in range(n):
        for k in range(j):
            A[j, j] -= A[j, k] * A[j, k]
        if not A[j, j] > 0.0:
            return False
        A[j, j] = sqrt(A[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] /= A[j, j]
    return True


@njit(cache=True, nogil=True)
def cholesky_solve(L, b):
    """In place: b <- (L L^T)^-1 b."""
    n = len(L)
    for i in range(n):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@njit(cache=True, nogil=True)
def _product(A, B):
    """A B of two 3x3 matrices; np.dot would ask for scipy."""
    C = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return C


@njit(cache=True, nogil=True)
def _homography(rays, xy, size, h):
    """H (row-major in h) with f x H (x / size, y / size, 1) = 0: least eigenvector of sum (I - f f^T) (x) X X^T."""
    M = np.zeros((9, 9))
    X = np.ones(3)
    for n in range(len(rays)):
        X[0], X[1] = xy[n, 0] / size, xy[n, 1] / size
        for i in range(3):
            for j in range(3):
                c = (1.0 if i == j else 0.0) - rays[n, i] * rays[n, j]
                for k in range(3):
                    for m in range(3):
                        M[3 * i + k, 3 * j + m] += c * X[k] * X[m]
    # Shifted, so that exact data stay positive definite; the shift does not move the eigenvector.
    shift = 1e-13 * len(rays)
    for i in range(9):
        M[i, i] += shift
    if not cholesky(M):
        return False
    for i in range(9):
        h[i] = 1.0 / (1.0 + i)
    for _ in range(_INVERSE_ITERATIONS):
        cholesky_solve(M, h)
        h /= sqrt((h * h).sum())
    return True


@njit(cache=True, nogil=True)
def _decompose(rays, xy, size, h, R, t):
    """Nearest rotation (both columns turned alike) and translation, the sign that puts the board before the rays."""
    facing = 0.0
    for n in range(len(rays)):
        for i in range(3):
            facing += rays[n, i] * (h[3 * i] * xy[n, 0] / size + h[3 * i + 1] * xy[n, 1] / size + h[3 * i + 2])
    sign = 1.0 if facing > 0.0 else -1.0
    a = sign * h[0::3] / size
    b = sign * h[1::3] / size
    norm_a, norm_b = sqrt((a * a).sum()), sqrt((b * b).sum())
    if norm_a < 1e-12 or norm_b < 1e-12:
        return False
    c, d = a / norm_a + b / norm_b, a / norm_a - b / norm_b
    norm_c, norm_d = sqrt((c * c).sum()), sqrt((d * d).sum())
    if norm_c < 1e-6 or norm_d < 1e-6:
        return False
    c, d = c / norm_c, d / norm_d  # orthogonal, as the sum and difference of unit vectors are
    scale = 1.0 / sqrt(2.0)
    R[:, 0], R[:, 1] = scale * (c + d), scale * (c - d)
    R[:, 2] = np.cross(R[:, 0], R[:, 1])
    t[:] = sign * h[2::3] * 2.0 / (norm_a + norm_b)
    return True


@njit(cache=True, nogil=True)
def _refine(rays, xy, scale, R, t):
    """Robust Gauss-Newton on u - f, u the unit vector to R X + t, weights 1 / (1 + (|u - f| / scale)^2), in place.

    Returns the robust cost, the mean of log(1 + (|u - f| / scale)^2), before the last step.
    """
    cost = np.inf
    J, e, unit = np.empty((3, 6)), np.empty(3), np.eye(3)
    for _ in range(_GAUSS_NEWTON_STEPS):
        A, b = np.zeros((6, 6)), np.zeros(6)
        cost = 0.0
        for n in range(len(rays)):
            x, y = xy[n, 0], xy[n, 1]
            p0 = R[0, 0] * x + R[0, 1] * y + t[0]
            p1 = R[1, 0] * x + R[1, 1] * y + t[1]
            p2 = R[2, 0] * x + R[2, 1] * y + t[2]
            inverse = 1.0 / sqrt(p0 * p0 + p1 * p1 + p2 * p2 + 1e-30)
            u0, u1, u2 = p0 * inverse, p1 * inverse, p2 * inverse
            e[0], e[1], e[2] = u0 - rays[n, 0], u1 - rays[n, 1], u2 - rays[n, 2]
            square = (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]) / (scale * scale)
            weight = 1.0 / (1.0 + square)
            cost += np.log(1.0 + square)
            for k in range(6):
                if k == 0:
                    d0, d1, d2 = y * R[0, 2], y * R[1, 2], y * R[2, 2]
                elif k == 1:
                    d0, d1, d2 = -x * R[0, 2], -x * R[1, 2], -x * R[2, 2]
                elif k == 2:
                    d0, d1, d2 = (x * R[0, 1] - y * R[0, 0], x * R[1, 1] - y * R[1, 0], x * R[2, 1] - y * R[2, 0])
                else:
                    d0, d1, d2 = unit[k - 3, 0], unit[k - 3, 1], unit[k - 3, 2]
                along = u0 * d0 + u1 * d1 + u2 * d2
                J[0, k] = (d0 - along * u0) * inverse
                J[1, k] = (d1 - along * u1) * inverse
                J[2, k] = (d2 - along * u2) * inverse
            for k in range(6):
                w0, w1, w2 = weight * J[0, k], weight * J[1, k], weight * J[2, k]
                b[k] -= w0 * e[0] + w1 * e[1] + w2 * e[2]
                for m in range(k + 1):
                    A[k, m] += w0 * J[0, m] + w1 * J[1, m] + w2 * J[2, m]
        for k in range(6):
            A[k, k] *= 1.0 + 1e-9
        if not cholesky(A):
            return np.inf
        cholesky_solve(A, b)
        angle = sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
        if angle > 0.5:  # beyond it the linearisation says nothing
            b *= 0.5 / angle
        R[:] = _product(R, so3.exp(b[:3]))
        t += b[3:]
        if angle < _STEP_TOLERANCE and (b[3:] * b[3:]).sum() < _STEP_TOLERANCE**2 * (t * t).sum():
            break
    return cost / len(rays)


@njit(cache=True, nogil=True)
def _mirrored(R, t):
    """The other planar solution in weak perspective (Schweighofer and Pinz 2006): depths mirrored about the centre."""
    v = t / sqrt((t * t).sum())
    S = np.eye(3) - 2.0 * np.outer(v, v)
    other = _product(S, R)
    other[:, 2] *= -1.0
    return other


@njit(cache=True, nogil=True)
def _spread(xy):
    """RMS distance from the centre, which `xy` is relative to, and the squared aspect of the corners' scatter."""
    a, b, c = (xy[:, 0] ** 2).mean(), (xy[:, 0] * xy[:, 1]).mean(), (xy[:, 1] ** 2).mean()
    larger = 0.5 * (a + c) + sqrt(0.25 * (a - c) ** 2 + b * b)
    return sqrt(a + c), (a * c - b * b) / (larger * larger + 1e-300)


@njit(cache=True, nogil=True)
def _best_pose(rays, xy, scale, R, t):
    """The better of the two planar poses, in place; False where there is none or both explain the rays alike."""
    size, aspect = _spread(xy)
    h = np.empty(9)
    if aspect < _FLAT or not _homography(rays, xy, size, h) or not _decompose(rays, xy, size, h, R, t):
        return False
    cost = _refine(rays, xy, scale, R, t)
    if not cost < np.inf:
        return False
    other, t_other = _mirrored(R, t), t.copy()
    cost_other = _refine(rays, xy, scale, other, t_other)
    same = R[0, 2] * other[0, 2] + R[1, 2] * other[1, 2] + R[2, 2] * other[2, 2] > _RIVAL_COSINE
    if cost_other < cost:
        R[:], t[:] = other, t_other
        cost, cost_other = cost_other, cost
    return same or cost_other > _RIVAL * cost


@njit(cache=True, nogil=True)
def _inlier_fraction(rays, xy, limit, R, t):
    inliers = 0
    for n in range(len(rays)):
        p = R[:, 0] * xy[n, 0] + R[:, 1] * xy[n, 1] + t
        d = p / sqrt((p * p).sum() + 1e-30) - rays[n]
        inliers += (d * d).sum() < limit * limit
    return inliers / len(rays)


@njit(cache=True, nogil=True)
def board_poses(rays, xy, start, scale, limit, inlier_share, R_board_cam, p_board_cam, ok):
    """Fill the pose of the camera in the board frame for each image, and whether it can be trusted.

    rays (N, 3) unit; xy (N, 2) board points [m]; corners of image i are start[i]:start[i+1]. scale, limit [rad]: of the
    robust cost, and of a corner that fits; inlier_share of the corners must fit.
    """
    for i in range(len(start) - 1):
        ok[i] = False
        first, last = start[i], start[i + 1]
        if last - first < _MIN_CORNERS:
            continue
        f = rays[first:last]
        local = np.empty((last - first, 2))
        cx, cy = xy[first:last, 0].mean(), xy[first:last, 1].mean()
        local[:, 0], local[:, 1] = xy[first:last, 0] - cx, xy[first:last, 1] - cy
        R, t = np.empty((3, 3)), np.empty(3)
        if not _best_pose(f, local, scale, R, t):
            continue
        ok[i] = _inlier_fraction(f, local, limit, R, t) >= inlier_share
        R_board_cam[i] = R.T
        for k in range(3):
            p_board_cam[i, k] = -(R[0, k] * t[0] + R[1, k] * t[1] + R[2, k] * t[2])
        p_board_cam[i, 0] += cx
        p_board_cam[i, 1] += cy
