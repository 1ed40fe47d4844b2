"""Bundle adjustment of one camera's parameters and the poses of its images, each image showing one body.

Levenberg-Marquardt with Huber's loss; the pose of each image is eliminated by the Schur complement.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from icalib.data.measurements import CornerStream
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.vectors import cross
from icalib.sensors.camera.initialize.boards.target_poses import FlatPoints, TargetPoses, target_poses

MAX_INTRINSICS_STEPS = 25  # of Levenberg-Marquardt; a good start needs about five
INTRINSICS_HUBER_PX = 1.5  # px; a few times the noise of detected corners
UNSEEN_COST_PX2 = 20.0 * INTRINSICS_HUBER_PX  # px^2, of a corner that the model cannot project
INTRINSICS_COST_TOLERANCE = 1e-6  # relative decrease of the cost at which the adjustment has converged
MAX_RMS_RATIO = 4.0  # of an image to the median one; the pose of an image with more is likely wrong
MIN_REJECTED_RMS_PX = 1.0  # px; images with less are never rejected


def has_good_pose(poses: TargetPoses) -> np.ndarray:
    """(M,) bool: images whose pose is a good start value."""
    return poses.rms_px < np.maximum(MAX_RMS_RATIO * np.median(poses.rms_px), MIN_REJECTED_RMS_PX)


def adjust_intrinsics(
    stream: CornerStream,
    model: CameraModel,
    params: np.ndarray,
    target: FlatPoints,
    free: np.ndarray,
    used: np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Parameters (P,) and robust cost [px^2] after a bundle adjustment of those numbered `free` (n,) and all poses.

    params: (P,) start values; used: (M,) bool, images in use, by default those with a good pose. Raises LinAlgError if
    the normal equations are singular.
    """
    poses = target_poses(stream, model, params, target)
    images = np.flatnonzero(has_good_pose(poses) if used is None else used)
    corners = _Corners.of(stream, target, images)
    R, p, damping = poses.rotation[images], poses.position[images], 1e-3
    system = _linearised(corners, model, params, free, R, p)
    for _ in range(MAX_INTRINSICS_STEPS):
        step = -np.linalg.solve(system.S + damping * np.diag(np.diag(system.S)), system.g)
        trial = params.copy()
        trial[free] += step
        trial_R, trial_p = system.moved_poses(step, R, p)
        after = _linearised(corners, model, trial, free, trial_R, trial_p)
        if after.cost < system.cost:
            has_converged = system.cost - after.cost < INTRINSICS_COST_TOLERANCE * system.cost
            params, R, p, system = trial, trial_R, trial_p, after
            damping *= 0.2
            if has_converged:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    return params, system.cost


class _Corners(NamedTuple):
    """Corners of m images, one image after the other.

    uv: (N, 2) [px]; points: (N, 3) [m] in the frame of the body; start: (m + 1,), image i has the corners
    start[i]:start[i + 1].
    """

    uv: np.ndarray
    points: np.ndarray
    start: np.ndarray

    @classmethod
    def of(cls, stream: CornerStream, target: FlatPoints, images: np.ndarray) -> _Corners:
        """The corners of the images numbered `images` (m,)."""
        rows = np.flatnonzero(np.isin(stream.image, images))
        start = np.concatenate([[0], np.cumsum(np.diff(stream.start)[images])])
        return cls(stream.uv[rows], target.points[stream.point[rows]], start)


class _IntrinsicsSystem(NamedTuple):
    """Normal equations of n free parameters, with the poses of m images eliminated.

    cost: robust cost [px^2]; S (n, n), g (n,): Schur complement and gradient; H_pose_inverse (m, 6, 6), g_pose
    (m, 6, 1): inverse block and gradient of each pose; C (m, 6, n): blocks between poses and parameters.
    """

    cost: float
    S: np.ndarray
    g: np.ndarray
    H_pose_inverse: np.ndarray
    C: np.ndarray
    g_pose: np.ndarray

    def moved_poses(self, step: np.ndarray, R: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses R (m, 3, 3), p (m, 3) after back-substitution of the `step` (n,) of the parameters."""
        d = -(self.H_pose_inverse @ (self.g_pose + (self.C @ step)[:, :, None]))[:, :, 0]
        return R @ so3.exp_many(np.ascontiguousarray(d[:, :3])), p + (R @ d[:, 3:, None])[:, :, 0]


def _linearised(
    corners: _Corners, model: CameraModel, params: np.ndarray, free: np.ndarray, R: np.ndarray, p: np.ndarray
) -> _IntrinsicsSystem:
    """The normal equations at camera poses R_body_cam (m, 3, 3) and p_body_cam (m, 3)."""
    ends = list(pairwise(corners.start))
    X = np.concatenate([(corners.points[a:b] - p[i]) @ R[i] for i, (a, b) in enumerate(ends)])
    uv, valid, J_point, J_params = model.project_with_jacobians(params, X)
    r = np.where(valid[:, None], uv - corners.uv, 0.0)
    size = np.sqrt((r**2).sum(axis=1))
    is_large, k = size > INTRINSICS_HUBER_PX, INTRINSICS_HUBER_PX
    cost = float(np.where(is_large, k * (size - 0.5 * k), 0.5 * size**2).sum())
    # Corners that cannot be projected have the cost of outliers, or parameters that project fewer would fit best.
    cost += float((~valid).sum()) * UNSEEN_COST_PX2
    weight = np.repeat(np.where(is_large, k / np.maximum(size, 1e-12), 1.0) * valid, 2)[:, None]
    J_pose = np.concatenate([cross(J_point, X[:, None, :]), -J_point], axis=2).reshape(-1, 6)
    J_free, residual = J_params[:, :, free].reshape(-1, len(free)), r.ravel()
    weighted_pose, weighted_free = J_pose * weight, J_free * weight
    rows = [slice(2 * a, 2 * b) for a, b in ends]
    H_pose_inverse = np.linalg.inv(_products(weighted_pose, J_pose, rows) + 1e-9 * np.eye(6))
    C, g_pose = _products(weighted_pose, J_free, rows), _products(weighted_pose, residual, rows)[:, :, None]
    eliminated = C.transpose(0, 2, 1) @ H_pose_inverse
    S = (_products(weighted_free, J_free, rows) - eliminated @ C).sum(axis=0)
    g = (_products(weighted_free, residual, rows) - (eliminated @ g_pose)[:, :, 0]).sum(axis=0)
    return _IntrinsicsSystem(cost, S, g, H_pose_inverse, C, g_pose)


def _products(A: np.ndarray, B: np.ndarray, rows: list[slice]) -> np.ndarray:
    """(m, a, ...) products A^T B over each of m slices `rows` of the rows of A (N, a) and B (N, ...)."""
    return np.array([A[k].T @ B[k] for k in rows]).reshape(len(rows), A.shape[1], *B.shape[1:])
