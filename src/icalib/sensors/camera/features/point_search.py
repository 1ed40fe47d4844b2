"""Compiled search for the scene points of tracks that minimise their reprojection cost, with poses and lenses fixed.

Indices of observations and tracks count as in `kernels`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.planes import tangents
from icalib.geometry.small import solve_definite
from icalib.optim.robust_weights import weight
from icalib.sensors.camera.features.kernels import in_camera

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
