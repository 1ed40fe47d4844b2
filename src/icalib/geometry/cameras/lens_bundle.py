"""Bundle adjustment of one lens, the shape of the target and the poses of images, from a good initial guess.

Levenberg-Marquardt; the poses are eliminated image by image (Schur complement). Points are kept in the camera frame: a
pose changes by a small rotation and translation of its image's points.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.cameras.convert import fit_rays
from icalib.geometry.vectors import cross

UNSEEN_PX = 20.0  # residual of a point outside the model's range; zero would reward a lens that sees fewer points
MOST_ROUNDS = 40  # steps, accepted or not
MOST_DAMPING = 1e8  # of the normal equations with unit diagonal; beyond it a step is down to rounding
SETTLED = 1e-5  # relative decrease of the sum of squares in an accepted step, below which it is the last
START_CORNERS = 1500  # about as many are used for initial parameters; the adjustment uses all
START_PX = 0.01  # a step to initial parameters that moves no point further is the last: the adjustment goes on


@dataclass(frozen=True)
class ImagePoints:
    """Points of the target in M images of one camera.

    points (N, 3) [m]: in the camera frame, by an estimate; uv (N, 2) [px]: where they were measured. Those of image i
    are start[i]:start[i + 1]; start (M + 1,) int, at least one point an image. basis (N, 3, s): derivative of the
    points by the shape parameters, in the camera frame. The shape is relative to that of the estimate. used (N,) bool:
    the points that are fitted.
    """

    points: np.ndarray
    uv: np.ndarray
    start: np.ndarray
    basis: np.ndarray
    used: np.ndarray

    @property
    def image(self) -> np.ndarray:
        """(N,) int: the image of each point."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))

    def moved(self, motion: np.ndarray, shape: np.ndarray) -> ImagePoints:
        """The points after a change of `shape` (s,) and a motion (M, 6) of each image's points in the camera frame.

        A motion is a rotation vector [rad] and a translation [m].
        """
        R = so3.exp_many(np.ascontiguousarray(motion[:, :3]))[self.image]
        points = np.einsum("nij,nj->ni", R, self.points + self.basis @ shape) + motion[self.image, 3:]
        return ImagePoints(points, self.uv, self.start, R @ self.basis, self.used)

    def sum_by_image(self, values: np.ndarray) -> np.ndarray:
        """(M, ...): the sum of values (N, ...) over the points of each image."""
        return np.add.reduceat(values, self.start[:-1], axis=0)


class Adjusted(NamedTuple):
    """A lens with `params` (P,) and what it leaves. shape (s,): the change of the target's shape; residual (N, 2) [px]:
    of all points, used or not; seen: the points with that shape, where the fitted poses have them.
    """

    params: np.ndarray
    shape: np.ndarray
    residual: np.ndarray
    seen: ImagePoints


def initial_parameters(
    model: CameraModel, other: CameraModel, params: np.ndarray, seen: ImagePoints
) -> np.ndarray | None:
    """Parameters (P,) of `model` for a lens that is known as `other` with `params`: from the best of its starts.

    They minimise the distance between projected and measured points, the points being fixed. A start that sees no more
    than half of the points is left out; None if all do. fx and fy start so that the scale in the image's centre is that
    of `other`.
    """
    few = np.flatnonzero(seen.used)[:: max(int(seen.used.sum()) // START_CORNERS, 1)]
    points, uv = seen.points[few], seen.uv[few]
    found = []
    for distortion in model.start_distortions:
        start = np.array([*params[:4], *distortion])
        start[:2] *= other.central_scale(params) / model.central_scale(start)
        visible = model.project(start, points)[1]
        if 2 * visible.sum() > len(uv):
            with suppress(np.linalg.LinAlgError):
                found.append(fit_rays(model, start, points[visible], uv[visible], START_PX))
    return min(found, key=lambda p: float((_residual(uv, *model.project(p, points)) ** 2).sum()), default=None)


def adjust(model: CameraModel, params: np.ndarray, seen: ImagePoints, fixed: np.ndarray | None = None) -> Adjusted:
    """Minimises the squared residuals of the used points over parameters, shape and poses, from `params` (P,).

    With a `fixed` shape (s,) only the poses are fitted, and `params` and `fixed` are returned as they are.

    Raises numpy.linalg.LinAlgError where the points of an image do not determine its pose.
    """
    shape, n = np.zeros(seen.basis.shape[2]), len(params)
    if fixed is not None:
        shape, n, seen = fixed, 0, seen.moved(np.zeros((len(seen.start) - 1, 6)), fixed)
    here, damping = _linearised(model, params, seen, fixed is None), 1e-4
    for _ in range(MOST_ROUNDS):
        step, motion = _step(*here, seen, damping)
        trial = params + step[:n] if n else params
        moved = seen.moved(motion, step[n:] if n else np.zeros(len(shape)))
        there = _linearised(model, trial, moved, fixed is None)
        before, after = (float((r[seen.used] ** 2).sum()) for r, _ in (here, there))
        if after < before:
            params, seen, here = trial, moved, there
            shape = shape + step[n:] if n else shape
            damping *= 0.1
            if before - after < SETTLED * before:
                break
        else:
            damping *= 10.0
            if damping > MOST_DAMPING:
                break
    return Adjusted(params, shape, here[0], seen)


def _linearised(
    model: CameraModel, params: np.ndarray, seen: ImagePoints, with_lens: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N, 2) [px], predicted - measured, and their Jacobian (N, 2, 6 + P + s).

    Columns: rotation and translation of the image's points, in the camera frame; then, `with_lens`, parameters and
    shape.
    """
    projected, valid, J_point, J_params = model.project_with_jacobians(params, seen.points)
    J_shared = (J_params, J_point @ seen.basis) if with_lens else ()
    J = np.concatenate([cross(seen.points[:, None, :], J_point), J_point, *J_shared], axis=2)
    return _residual(seen.uv, projected, valid), J


def _residual(uv: np.ndarray, projected: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(N, 2) [px] projected - measured, `UNSEEN_PX` long where the model sees no point."""
    return np.where(valid[:, None], projected - uv, np.sqrt(0.5) * UNSEEN_PX)


def _step(residual: np.ndarray, J: np.ndarray, seen: ImagePoints, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the shared parameters, lens and shape (n,), and of the images' poses (M, 6), by the Schur complement.

    Both diagonals are damped, relative to themselves. J (N, 2, 6 + n) as `_linearised` gives it.
    """
    rows = np.concatenate([J, residual[:, :, None]], axis=2)
    rows[~seen.used] = 0.0
    images = (rows[a:b].reshape(-1, rows.shape[2]) for a, b in pairwise(seen.start))
    grams = np.array([own.T @ own for own in images])
    whole = grams[:, 6:, 6:].sum(axis=0)
    H, C, g = grams[:, :6, :6], grams[:, :6, 6:-1], grams[:, :6, -1]
    diagonal = np.einsum("mii->mi", H)
    diagonal *= 1.0 + damping
    diagonal += 1e-12 * diagonal.max(axis=1, keepdims=True)
    solved = np.linalg.solve(H, np.concatenate([C, g[:, :, None]], axis=2))
    S = whole[:-1, :-1] - np.einsum("mki,mkj->ij", C, solved[:, :, :-1])
    b = whole[:-1, -1] - np.einsum("mki,mk->i", C, solved[:, :, -1])
    scale = np.sqrt(np.maximum(np.diag(whole)[:-1], 1e-300))
    scaled = S / scale[:, None] / scale + damping * np.eye(len(b))
    step = -np.linalg.lstsq(scaled, b / scale, rcond=1e-13)[0] / scale
    return step, -solved[:, :, -1] - np.einsum("mij,j->mi", solved[:, :, :-1], step)
