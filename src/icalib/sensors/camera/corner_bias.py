"""Edge bloom: the apparent shift of dark edges in the image, caused by blur and by the response of the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.geometry.cameras.base import CameraModel
from icalib.optim import memory
from icalib.optim.state import State
from icalib.sensors.camera.corner_factor import CornerFactor


def with_bloom(factor: CornerFactor, state: State) -> CornerFactor:
    """The factor with the image direction in which bloom shifts each corner: towards the centre of its tag, projected
    with the lens and poses of `state`."""
    target = factor.bodies.target
    inwards = target.tag_centers - target.points
    params = factor.lens(state)
    direction = memory.mmap_zeros(factor.stream.uv.shape, np.float32)
    for rows, X, R_cam_body in factor.in_camera(state):
        towards = np.einsum("nij,nj->ni", R_cam_body, inwards[factor.stream.point[rows]])
        direction[rows] = bloom_direction(factor.model, params, X, towards)
    return factor.with_direction(direction)


def bloom_direction(model: CameraModel, params: np.ndarray, X: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """(N, 2) unit image directions of the vectors `towards` (N, 3) at points X (N, 3) m, both in the camera frame.

    Zero for points outside the range of the lens model. params (P,): parameters of `model`."""
    _, valid, J, _ = model.project_with_jacobians(params, X)
    d = np.einsum("nij,nj->ni", J, towards)
    norm = np.linalg.norm(d, axis=1)
    ok = valid & (norm > 0.0)
    return np.where(ok[:, None], d / np.where(ok, norm, 1.0)[:, None], 0.0)


# Corrects the detected centres of circles for the eccentricity of their images.
#
# A detector fits an ellipse to the image of a circle. The centre of that ellipse is not the image of the circle's
# centre: perspective and lens distortion move it (Heikkila, IEEE TPAMI 22, 2000). Once lens and pose are known, so is
# the shift:
#
#     uv -= centre of the ellipse fitted to the projected circle - projection of the circle's centre
#
# The shift grows with the square of a circle's size in the image. Left out, it biases focal lengths and distortion.

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


# Corrects corners for the curvature that the lens gives to the edges of squares and tags.
#
# A detector fits the two edges of a corner over some length, as straight lines or with a free curvature. It states
# this fitted curvature (zero for straight lines) and the gain [px^2], the derivative of the corner by the curvature of
# each edge. The true curvature can be predicted once lens and pose are known:
#
#     uv += gain (predicted curvature - fitted curvature)
#
# To first order, the result is the corner of a fit with known curvature. Without the correction, straight fits in a
# distorted image give biased corners; the bias grows with the square of the fitted length.

# Determinant of the affine map from target plane to image at unit depth, over fx^2: 0 if the plane is seen edge-on.
# Below this value the map is not inverted, and the corner is not corrected.
MIN_RELATIVE_AREA = 1e-6


def with_bent_edges(factor: CornerFactor, state: State) -> CornerFactor:
    """The factor with corrected corners, for lens and poses of `state`. Unchanged if the stream has no edges."""
    if not len(factor.stream.edges):
        return factor
    uv = factor.stream.uv.copy()
    params = factor.lens(state)
    for rows, X, R_cam_body in factor.in_camera(state):
        plane = R_cam_body[:, :, :2]
        for edge in factor.stream.edges[rows].transpose(1, 0, 2):
            fitted = edge.astype(np.float64)
            curvature, known = predicted_curvature(factor.model, params, X, plane, fitted[:, :4].reshape(-1, 2, 2))
            uv[rows] += np.where(known, curvature - fitted[:, 6], 0.0)[:, None] * fitted[:, 4:6]
    return replace(factor, stream=replace(factor.stream, uv=uv))


def predicted_curvature(
    model: CameraModel, params: np.ndarray, X: np.ndarray, plane: np.ndarray, piece: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) image curvature [1 / px] of straight edge pieces on the target, and (n,) bool, whether it is known.

    X (n, 3) m: the corners in the camera frame; plane (n, 3, 2): the body's unit axes x and y in the camera frame;
    piece (n, 2, 2) px: its two ends, relative to the corner. The sign is that of `CornerStream.edges`. Unknown if a
    point is outside the range of the lens model, or the plane is seen edge-on.

    The ends and the middle of the piece are mapped to the target by the affine map at the corner, and projected. The
    curvature is the component of their second difference across the chord, over a quarter of the chord's squared
    length.
    """
    _, valid, J_point, _ = model.project_with_jacobians(params, X)
    A = J_point @ plane  # px/m, from the target's plane to the image
    area = np.linalg.det(A)
    known = valid & (np.abs(area * X[:, 2] ** 2) > MIN_RELATIVE_AREA * params[0] ** 2)
    inverse = np.linalg.inv(np.where(known[:, None, None], A, np.eye(2)))
    uv = []
    for offset in (piece[:, 0], piece.mean(axis=1), piece[:, 1]):
        point = X + np.einsum("nij,njk,nk->ni", plane, inverse, offset)
        projected, valid = model.project(params, point)
        known &= valid
        uv.append(projected)
    chord = uv[2] - uv[0]
    second_difference = uv[0] + uv[2] - 2.0 * uv[1]
    square = (chord**2).sum(axis=1)
    known &= square > 0.0
    across = chord[:, 1] * second_difference[:, 0] - chord[:, 0] * second_difference[:, 1]
    return across / np.where(known, 0.25 * square**1.5, 1.0), known
