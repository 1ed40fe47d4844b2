"""Converts a lens to another camera model, for programs that support only that model.

Bundle adjustment of one lens, the shape of the target and the poses of images, from a good initial guess.

Levenberg-Marquardt. The poses are eliminated image by image (Schur complement). Points are stored in the camera frame:
a pose change is a small rotation and translation of the points of its image.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from icalib.errors import CalibrationError
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.small import cross

_GRID = (48, 32)  # number of pixels across and down, including the image borders
_MAX_STEPS = 200  # ten are enough, unless the best fit is outside the model's range
_LEAST_DAMPING, _MOST_DAMPING = 1e-12, 1e8  # relative to a unit diagonal of the normal equations
_SETTLED_PX = 1e-9  # iteration stops if a step moves no pixel further


def fit_model(
    source: CameraModel, params: np.ndarray, target: CameraModel, resolution: tuple[int, int]
) -> tuple[np.ndarray, float, float]:
    """Parameters of `target` that project like `source` with `params`, by least squares in pixels over the image.

    A grid of pixels of the image of `resolution` (width, height) [px] is unprojected by `source` and projected by
    `target`. Pixels without a ray are omitted. The fit starts with the fx, fy, cx, cy of the source and zero
    distortion. Damped Gauss-Newton steps keep all rays in the monotonic range of the target; if the best fit is
    outside, the result is at the edge.

    Returns the parameters (P,), and RMS and maximum over the grid of the distance between both projections [px]. Check
    these, as a model that cannot represent the lens is fitted as well as possible. Raises CalibrationError if the
    source has too few rays in the image, or the target cannot project one of them.
    """
    uv, rays = _rays(source, np.asarray(params, float), resolution)
    if 2 * len(uv) < len(target.parameter_names):
        raise CalibrationError(
            f"{source.name} with these parameters can see {len(uv)} of {_GRID[0] * _GRID[1]} pixels of the image, too "
            f"few to fit {target.name}; check its parameters and the resolution {resolution[0]}x{resolution[1]}."
        )
    fitted = np.zeros(len(target.parameter_names))
    fitted[:4] = params[:4]
    unseen = int((~target.project(fitted, rays)[1]).sum())
    if unseen:
        raise CalibrationError(
            f"{target.name} cannot see {unseen} of the {len(rays)} directions that {source.name} sees in this image, "
            "90 degrees or more from the optical axis; choose a fisheye model."
        )
    fitted = fit_rays(target, fitted, rays, uv)
    distance = np.linalg.norm(target.project(fitted, rays)[0] - uv, axis=1)
    return fitted, float(np.sqrt(np.mean(distance**2))), float(distance.max())


def _rays(source: CameraModel, params: np.ndarray, resolution: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of a grid over the image, and their rays (N, 3); pixels without a ray are omitted."""
    u, v = np.meshgrid(*(np.linspace(0.0, side - 1.0, count) for side, count in zip(resolution, _GRID, strict=True)))
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, valid = source.unproject(params, uv)
    return uv[valid], rays[valid]


def fit_rays(
    target: CameraModel, params: np.ndarray, rays: np.ndarray, uv: np.ndarray, settled_px: float = _SETTLED_PX
) -> np.ndarray:
    """Parameters (P,) of `target` that project rays (N, 3) to uv (N, 2) [px], by Levenberg-Marquardt. All rays must be
    valid for the initial `params` (P,). Iteration stops if a step moves no pixel further than `settled_px`."""
    damping = _LEAST_DAMPING
    for _ in range(_MAX_STEPS):
        projected, _, _, j_params = target.project_with_jacobians(params, rays)
        residual, J = (projected - uv).ravel(), j_params.reshape(2 * len(uv), -1)
        scale = np.linalg.norm(J, axis=0)
        padded = np.append(residual, np.zeros(len(params)))
        while True:
            damped = np.vstack([J / scale, np.sqrt(damping) * np.eye(len(params))])
            step = -np.linalg.lstsq(damped, padded, rcond=None)[0] / scale
            trial, valid = target.project(params + step, rays)
            if valid.all() and np.sum((trial - uv) ** 2) < residual @ residual:
                break
            damping *= 10.0
            if damping > _MOST_DAMPING:  # the step is below rounding: converged
                return params
        params, damping = params + step, max(0.1 * damping, _LEAST_DAMPING)
        if np.abs(J @ step).max() < settled_px:
            return params
    return params


UNSEEN_PX = 20.0  # length of the residual of an invalid point; zero would favour lenses with fewer valid points
MOST_ROUNDS = 40  # largest number of steps, accepted or rejected
MOST_DAMPING = 1e8  # relative to a unit diagonal of the normal equations; beyond it steps are below rounding
SETTLED = 1e-5  # relative decrease of the sum of squares in an accepted step, below which iteration stops
START_CORNERS = 1500  # approximate number of points for initial parameters; the adjustment uses all
START_PX = 0.01  # initial parameters are accurate enough if a step moves no point further


@dataclass(frozen=True)
class ImagePoints:
    """Points of the target in M images of one camera.

    points (N, 3) [m]: estimated position in the camera frame; uv (N, 2) [px]: measured position. Points of image i are
    start[i]:start[i + 1]; start (M + 1,) int, with at least one point per image. basis (N, 3, s): derivative of the
    points by the s shape parameters, in the camera frame. Shape parameters are relative to the initial shape. used (N,)
    bool: points that are fitted.
    """

    points: np.ndarray
    uv: np.ndarray
    start: np.ndarray
    basis: np.ndarray
    used: np.ndarray

    @property
    def image(self) -> np.ndarray:
        """(N,) int: index of the image of each point."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))

    def moved(self, motion: np.ndarray, shape: np.ndarray) -> ImagePoints:
        """The points after a change `shape` (s,) of the shape, and a motion (M, 6) of each image's points in the camera
        frame.

        A motion is a rotation vector [rad] followed by a translation [m].
        """
        R = so3.exp_many(np.ascontiguousarray(motion[:, :3]))[self.image]
        points = np.einsum("nij,nj->ni", R, self.points + self.basis @ shape) + motion[self.image, 3:]
        return ImagePoints(points, self.uv, self.start, R @ self.basis, self.used)

    def sum_by_image(self, values: np.ndarray) -> np.ndarray:
        """(M, ...) sums of values (N, ...) over the points of each image."""
        return np.add.reduceat(values, self.start[:-1], axis=0)


class Adjusted(NamedTuple):
    """Result of the adjustment. params (P,): lens; shape (s,): change of the target's shape; residual (N, 2) [px]: of
    all points, used or not; points: with the adjusted shape and poses."""

    params: np.ndarray
    shape: np.ndarray
    residual: np.ndarray
    points: ImagePoints


def initial_parameters(
    model: CameraModel, known_model: CameraModel, params: np.ndarray, points: ImagePoints
) -> np.ndarray | None:
    """Initial parameters (P,) of `model` for a lens that is known in the model `known_model` as `params`.

    They minimise the distance between projected and measured points, with the points fixed, from the best of the
    model's `start_distortions`. A start for which at most half of the points are valid is omitted; None if all are. fx
    and fy start with the scale of `known_model` at the optical axis.
    """
    few = np.flatnonzero(points.used)[:: max(int(points.used.sum()) // START_CORNERS, 1)]
    xyz, uv = points.points[few], points.uv[few]
    fits = []
    for distortion in model.start_distortions:
        start = np.array([*params[:4], *distortion])
        start[:2] *= known_model.central_scale(params) / model.central_scale(start)
        visible = model.project(start, xyz)[1]
        if 2 * visible.sum() > len(uv):
            with suppress(np.linalg.LinAlgError):
                fits.append(fit_rays(model, start, xyz[visible], uv[visible], START_PX))
    return min(fits, key=lambda p: float((_residual(uv, *model.project(p, xyz)) ** 2).sum()), default=None)


def adjust(model: CameraModel, params: np.ndarray, points: ImagePoints, fixed: np.ndarray | None = None) -> Adjusted:
    """Minimise the squared residuals of the used points over lens parameters, shape and poses, from `params` (P,).

    With a `fixed` shape (s,) only the poses are fitted, and `params` and `fixed` are returned unchanged. Raises
    numpy.linalg.LinAlgError if the points of an image do not determine its pose.
    """
    shape, n = np.zeros(points.basis.shape[2]), len(params)
    if fixed is not None:
        shape, n, points = fixed, 0, points.moved(np.zeros((len(points.start) - 1, 6)), fixed)
    at_params, damping = _linearised(model, params, points, fixed is None), 1e-4
    for _ in range(MOST_ROUNDS):
        step, motion = _step(*at_params, points, damping)
        trial_params = params + step[:n] if n else params
        trial_points = points.moved(motion, step[n:] if n else np.zeros(len(shape)))
        at_trial = _linearised(model, trial_params, trial_points, fixed is None)
        before, after = (float((r[points.used] ** 2).sum()) for r, _ in (at_params, at_trial))
        if after < before:
            params, points, at_params = trial_params, trial_points, at_trial
            shape = shape + step[n:] if n else shape
            damping *= 0.1
            if before - after < SETTLED * before:
                break
        else:
            damping *= 10.0
            if damping > MOST_DAMPING:
                break
    return Adjusted(params, shape, at_params[0], points)


def _linearised(
    model: CameraModel, params: np.ndarray, points: ImagePoints, with_lens: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N, 2) [px], predicted - measured, and their Jacobian (N, 2, 6 + P + s).

    Columns: rotation and translation of the image's points in the camera frame; then lens parameters and shape, if
    `with_lens`.
    """
    projected, valid, J_point, J_params = model.project_with_jacobians(params, points.points)
    J_shared = (J_params, J_point @ points.basis) if with_lens else ()
    J = np.concatenate([cross(points.points[:, None, :], J_point), J_point, *J_shared], axis=2)
    return _residual(points.uv, projected, valid), J


def _residual(uv: np.ndarray, projected: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(N, 2) projected - measured [px]; of length `UNSEEN_PX` for invalid points."""
    return np.where(valid[:, None], projected - uv, np.sqrt(0.5) * UNSEEN_PX)


def _step(residual: np.ndarray, J: np.ndarray, points: ImagePoints, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the shared parameters, lens and shape (n,), and of the poses (M, 6), by the Schur complement.

    Both diagonals are damped relative to themselves. J (N, 2, 6 + n): Jacobian from `_linearised`.
    """
    rows = np.concatenate([J, residual[:, :, None]], axis=2)
    rows[~points.used] = 0.0
    images = (rows[a:b].reshape(-1, rows.shape[2]) for a, b in pairwise(points.start))
    grams = np.array([image_rows.T @ image_rows for image_rows in images])
    total = grams[:, 6:, 6:].sum(axis=0)
    H, C, g = grams[:, :6, :6], grams[:, :6, 6:-1], grams[:, :6, -1]
    diagonal = np.einsum("mii->mi", H)
    diagonal *= 1.0 + damping
    diagonal += 1e-12 * diagonal.max(axis=1, keepdims=True)
    solved = np.linalg.solve(H, np.concatenate([C, g[:, :, None]], axis=2))
    S = total[:-1, :-1] - np.einsum("mki,mkj->ij", C, solved[:, :, :-1])
    b = total[:-1, -1] - np.einsum("mki,mk->i", C, solved[:, :, -1])
    scale = np.sqrt(np.maximum(np.diag(total)[:-1], 1e-300))
    scaled = S / scale[:, None] / scale + damping * np.eye(len(b))
    step = -np.linalg.lstsq(scaled, b / scale, rcond=1e-13)[0] / scale
    return step, -solved[:, :, -1] - np.einsum("mij,j->mi", solved[:, :, :-1], step)
