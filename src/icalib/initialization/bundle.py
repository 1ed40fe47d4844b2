"""Small bundle adjustment: one camera's parameters and the board's pose in each of a few images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.geometry.cameras import CameraModel

_ITERATIONS = 40
_HUBER_PX = 1.5
_INVISIBLE_PX = 50.0  # what a corner costs that the model cannot project, so that none is gained by losing it
_CONVERGED = 1e-3  # predicted decrease of the cost, px^2


@dataclass(frozen=True)
class Views:
    """Corners of the images to adjust: point (N, 3) board, uv (N, 2); corners of image i are start[i]:start[i+1]."""

    point: np.ndarray
    uv: np.ndarray
    start: np.ndarray

    @property
    def image(self) -> np.ndarray:
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))


@dataclass(frozen=True)
class _Normal:
    """Normal equations: poses (m, 6, 6), camera (P, 6) coupling of each, camera (P, P), and the gradients."""

    poses: np.ndarray
    coupling: np.ndarray
    camera: np.ndarray
    b_poses: np.ndarray
    b_camera: np.ndarray


def adjust(
    model: CameraModel,
    params: np.ndarray,
    R_cam_board: np.ndarray,
    t_cam_board: np.ndarray,
    views: Views,
    prior_sigma: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levenberg-Marquardt on Huber's cost of the reprojection errors; the better estimate is kept at every step.

    prior_sigma (P,): about the params (P,) given; 0 holds a parameter, and a broad one keeps what the images do not
    show from drifting. Returns the parameters, R_cam_board (m, 3, 3) and t_cam_board (m, 3).
    """
    mean, free = params.copy(), prior_sigma > 0.0
    weight = np.where(free, 1.0 / np.where(free, prior_sigma, 1.0) ** 2, 0.0)
    best = (params, R_cam_board, t_cam_board)
    cost, damping = _cost(model, *best, views) + float(weight @ (params - mean) ** 2), 1e-3
    for _ in range(_ITERATIONS):
        normal = _normal_equations(model, *best, views)
        while damping < 1e8:
            d_camera, d_poses, gain = _step(normal, weight, best[0] - mean, free, damping)
            trial = (
                best[0] + d_camera,
                best[1] @ so3.exp_many(np.ascontiguousarray(d_poses[:, :3])),
                best[2] + d_poses[:, 3:],
            )
            trial_cost = _cost(model, *trial, views) + float(weight @ (trial[0] - mean) ** 2)
            if trial_cost < cost:
                best, cost, damping = trial, trial_cost, max(damping / 5.0, 1e-9)
                break
            if gain < _CONVERGED:
                return best
            damping *= 5.0
        if gain < _CONVERGED:
            break
    return best


def reprojection_errors(
    model: CameraModel, params: np.ndarray, R: np.ndarray, t: np.ndarray, views: Views
) -> np.ndarray:
    """(N,) px, _INVISIBLE_PX where the model cannot project the corner."""
    uv, valid = model.project(params, _in_camera(R, t, views))
    return np.where(valid, np.linalg.norm(uv - views.uv, axis=1), _INVISIBLE_PX)


def _in_camera(R: np.ndarray, t: np.ndarray, views: Views) -> np.ndarray:
    image = views.image
    return np.einsum("nij,nj->ni", R[image], views.point) + t[image]


def _cost(model: CameraModel, params: np.ndarray, R: np.ndarray, t: np.ndarray, views: Views) -> float:
    if not (params[:2] > 0.0).all():
        return np.inf
    error = reprojection_errors(model, params, R, t, views)
    inner = np.minimum(error, _HUBER_PX)
    return float(np.sum(inner * (2.0 * error - inner)))


def _normal_equations(model: CameraModel, params: np.ndarray, R: np.ndarray, t: np.ndarray, views: Views) -> _Normal:
    image = views.image
    uv, valid, j_point, j_params = model.project_with_jacobians(params, _in_camera(R, t, views))
    residual = np.where(valid[:, None], uv - views.uv, 0.0)
    error = np.linalg.norm(residual, axis=1)
    w = (_HUBER_PX / np.maximum(error, _HUBER_PX) * valid)[:, None, None]
    J_R = j_point @ R[image]  # rows of -J R [X]x are X x (R^T J)
    J_pose = np.concatenate([np.cross(views.point[:, None, :], J_R), j_point], axis=2)
    Jt_pose, Jt_params, first = (w * J_pose).transpose(0, 2, 1), (w * j_params).transpose(0, 2, 1), views.start[:-1]
    return _Normal(
        np.add.reduceat(Jt_pose @ J_pose, first, axis=0),
        np.add.reduceat(Jt_params @ J_pose, first, axis=0),
        np.sum(Jt_params @ j_params, axis=0),
        np.add.reduceat((Jt_pose @ residual[:, :, None])[:, :, 0], first, axis=0),
        np.sum((Jt_params @ residual[:, :, None])[:, :, 0], axis=0),
    )


def _step(
    normal: _Normal, weight: np.ndarray, from_mean: np.ndarray, free: np.ndarray, damping: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Steps of camera (P,) and poses (m, 6), and the predicted decrease of the cost; poses are eliminated (Schur)."""
    poses = normal.poses + damping * np.eye(6) * normal.poses + 1e-12 * np.eye(6)
    camera = normal.camera + np.diag(weight)
    camera = camera + damping * np.diag(np.diag(camera))
    b_camera = normal.b_camera + weight * from_mean
    gain = np.linalg.solve(poses, normal.coupling.transpose(0, 2, 1)).transpose(0, 2, 1)  # coupling poses^-1
    S = camera - np.sum(gain @ normal.coupling.transpose(0, 2, 1), axis=0)
    rhs = -b_camera + np.einsum("mpk,mk->p", gain, normal.b_poses)
    d_camera = np.zeros(len(rhs))
    d_camera[free] = np.linalg.solve(S[np.ix_(free, free)], rhs[free])
    back = -normal.b_poses - np.einsum("mpk,p->mk", normal.coupling, d_camera)
    d_poses = np.linalg.solve(poses, back[:, :, None])[:, :, 0]
    return d_camera, d_poses, -float(b_camera[free] @ d_camera[free] + np.sum(normal.b_poses * d_poses))
