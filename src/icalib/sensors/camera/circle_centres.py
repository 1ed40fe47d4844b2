"""Corrects the detected centres of circles for the eccentricity of their images.

A detector fits an ellipse to the image of a circle. The centre of that ellipse is not the image of the circle's centre:
perspective and lens distortion move it (Heikkila, IEEE TPAMI 22, 2000). Once lens and pose are known, so is the shift:

    uv -= centre of the ellipse fitted to the projected circle - projection of the circle's centre

The shift grows with the square of a circle's size in the image. Left out, it biases focal lengths and distortion.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.geometry.cameras.base import CameraModel
from icalib.optim.state import State
from icalib.sensors.camera.corner_factor import CornerFactor

# Sampled points of a circle. Sums over a smooth closed contour converge faster than any power of this number.
N_CONTOUR_POINTS = 32
ELLIPSE_ITERATIONS = 3  # Gauss-Newton steps from the affine image of the circle; convergence is quadratic
CONTOUR_ANGLES = 2.0 * np.pi * np.arange(N_CONTOUR_POINTS) / N_CONTOUR_POINTS
UNIT_CIRCLE = np.stack([np.cos(CONTOUR_ANGLES), np.sin(CONTOUR_ANGLES)], axis=1)


def with_circle_centres(factor: CornerFactor, state: State) -> CornerFactor:
    """The factor with corrected centres of circles, by lens and poses of `state`; unchanged without circles."""
    if not factor.bodies.target.radii.any():
        return factor
    stream = factor.stream
    return replace(factor, stream=replace(stream, uv=stream.uv - centre_shifts(factor, state)))


def centre_shifts(factor: CornerFactor, state: State) -> np.ndarray:
    """(N, 2) px: the shift of each corner, centre of its ellipse - projection of the circle's centre.

    Zero for points that are no centres of circles, and where a part of the circle has no image.
    """
    shift, radii = np.zeros((len(factor.stream.uv), 2)), factor.bodies.target.radii
    params = factor.lens(state)
    for rows, X, R_cam_body in factor.in_camera(state):
        radius = radii[factor.stream.point[rows]]
        shift[rows] = ellipse_shift(factor.model, params, X, R_cam_body[:, :, :2], radius)
    return shift


def ellipse_shift(
    model: CameraModel, params: np.ndarray, X: np.ndarray, plane: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """(n, 2) px: shift of the ellipse's centre from the projected centre of the circle; zero as in `centre_shifts`.

    X (n, 3) m: the centres in the camera frame; plane (n, 3, 2): two perpendicular unit vectors of the circle's plane
    in the camera frame; radius (n,) m, 0 for points that are no circles. The ellipse minimises the squared distance
    from the projected circle, integrated over its arc length, because edge pixels are spread evenly along the edge.
    """
    uv, valid, J_point, _ = model.project_with_jacobians(params, X)
    rim = X[:, None] + radius[:, None, None] * np.einsum("nij,kj->nki", plane, UNIT_CIRCLE)
    contour, projects = model.project(params, rim.reshape(-1, 3))
    contour = contour.reshape(len(X), N_CONTOUR_POINTS, 2)
    shape = radius[:, None, None] * (J_point @ plane)
    known = valid & projects.reshape(len(X), -1).all(axis=1) & (np.abs(np.linalg.det(shape)) > 0.0)
    contour, centre = contour[known], uv[known]
    W = np.linalg.inv(shape[known])  # 1/px; maps the ellipse to the unit circle
    arc = np.linalg.norm(np.roll(contour, -1, axis=1) - np.roll(contour, 1, axis=1), axis=2)
    for _ in range(ELLIPSE_ITERATIONS):
        centre, W = _step(contour, arc, centre, W)
    shift = np.zeros((len(X), 2))
    shift[known] = centre - uv[known]
    return shift


def _step(contour: np.ndarray, arc: np.ndarray, centre: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss-Newton step of the ellipses |W (u - centre)| = 1 through contours (n, k, 2) px.

    The residuals are Sampson distances [px], weighted by arc (n, k) px. Returns centre (n, 2) px and W (n, 2, 2) 1/px.
    """
    y = np.einsum("nij,nkj->nki", W, contour - centre[:, None])
    radius = np.linalg.norm(y, axis=2)
    unit = y / radius[..., None]
    J_radius = np.einsum("nki,nij->nkj", unit, W)  # d radius / d u
    gradient = np.linalg.norm(J_radius, axis=2)
    # A rotation of the unit circle does not change the ellipse: W <- (I + S) W, with S symmetric.
    J_shape = np.stack([unit[..., 0] * y[..., 0], unit[..., 1] * y[..., 1], 2.0 * unit[..., 0] * y[..., 1]], 2)
    J = np.concatenate([-J_radius, J_shape], axis=2) / gradient[..., None]
    weighted = arc[..., None] * J
    g = weighted.swapaxes(1, 2) @ ((radius - 1.0) / gradient)[..., None]
    step = -np.linalg.solve(weighted.swapaxes(1, 2) @ J, g)[..., 0]
    S = np.stack([np.stack([step[:, 2], step[:, 4]], axis=1), np.stack([step[:, 4], step[:, 3]], axis=1)], axis=1)
    return centre + step[:, :2], W + S @ W
