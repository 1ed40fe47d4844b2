"""Converts a lens to another camera model, for programs that support only that model."""

from __future__ import annotations

import numpy as np

from icalib.errors import CalibrationError
from icalib.geometry.cameras.base import CameraModel

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
