"""Centres of circles moved to where their projections are.

A detector fits an ellipse to the image of a circle. Its centre is not the image of the circle's centre: perspective
moves it towards the nearer half, and a lens that bends moves it as well (Heikkila, IEEE TPAMI 22, 2000). Once lens and
pose are known, so is the difference:

    uv += projection of the centre - centre of the ellipse fitted to the projected circle

Left out, it moves focal lengths and distortion, for it grows with the square of a circle's size in the image.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.estimation.corner_factor import CornerFactor
from icalib.estimation.state import State
from icalib.geometry.cameras.base import CameraModel

N_CONTOUR = 32  # points of a circle
ROUNDS = 3  # of the fit; the second step is of the order of the square of the first
ANGLES = 2.0 * np.pi * np.arange(N_CONTOUR) / N_CONTOUR
UNIT = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)


def with_circle_centres(factor: CornerFactor, state: State) -> CornerFactor:
    """The factor with the centres of circles moved to where lens and poses of `state` project them."""
    if not factor.bodies.target.radii.any():
        return factor
    stream = factor.stream
    return replace(factor, stream=replace(stream, uv=stream.uv - centre_shifts(factor, state)))


def centre_shifts(factor: CornerFactor, state: State) -> np.ndarray:
    """(N, 2) px from the projection of each corner's point to the centre of the ellipse that its circle is seen as; 0
    of points that are no circle's, or where a part of the circle has no image."""
    shift, radii = np.zeros((len(factor.stream.uv), 2)), factor.bodies.target.radii
    params = np.concatenate([state.values[factor.name, "intrinsics"], state.values[factor.name, "distortion"]])
    for v0, v1 in factor.blocks():
        own = factor.corners_of(v0, v1)
        X, R_cam_body = factor.points_in_camera(state, v0, v1)
        plane = R_cam_body[factor.views.of_corners(v0, v1) - v0, :, :2]
        shift[own] = ellipse_shift(factor.model, params, X, plane, radii[factor.stream.point[own]])
    return shift


def ellipse_shift(
    model: CameraModel, params: np.ndarray, X: np.ndarray, plane: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """(n, 2) px, as `centre_shifts`. X (n, 3) m: the centres in the camera's frame; plane (n, 3, 2): two unit vectors
    of the circle's plane; radius (n,) m.

    The ellipse has the least squared distances, by arc length, from the projected circle, as the detector's has.
    """
    uv, valid, J_point, _ = model.project_with_jacobians(params, X)
    rim = X[:, None] + radius[:, None, None] * np.einsum("nij,kj->nki", plane, UNIT)
    contour, seen = model.project(params, rim.reshape(-1, 3))
    contour = contour.reshape(len(X), N_CONTOUR, 2)
    shape = radius[:, None, None] * (J_point @ plane)
    known = valid & seen.reshape(len(X), -1).all(axis=1) & (np.abs(np.linalg.det(shape)) > 0.0)
    contour, centre = contour[known], uv[known]
    inverse = np.linalg.inv(shape[known])  # of the map from the unit circle to the ellipse
    arc = np.linalg.norm(np.roll(contour, -1, axis=1) - np.roll(contour, 1, axis=1), axis=2)
    for _ in range(ROUNDS):
        centre, inverse = _step(contour, arc, centre, inverse)
    shift = np.zeros((len(X), 2))
    shift[known] = centre - uv[known]
    return shift


def _step(
    contour: np.ndarray, arc: np.ndarray, centre: np.ndarray, inverse: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss-Newton step of ellipses |A (u - centre)| = 1 through contours (n, k, 2), weighted by arc (n, k)."""
    y = np.einsum("nij,nkj->nki", inverse, contour - centre[:, None])
    radius = np.linalg.norm(y, axis=2)
    towards = y / radius[..., None]
    slope = np.einsum("nki,nij->nkj", towards, inverse)  # of the radius by u
    steepness = np.linalg.norm(slope, axis=2)
    # The rotation of A's image is no part of the ellipse: A changes by a symmetric matrix from the left.
    by_shape = np.stack(
        [towards[..., 0] * y[..., 0], towards[..., 1] * y[..., 1], 2.0 * towards[..., 0] * y[..., 1]], 2
    )
    J = np.concatenate([-slope, by_shape], axis=2) / steepness[..., None]
    weight = arc[..., None] * J
    d = np.linalg.solve(weight.swapaxes(1, 2) @ J, -(weight.swapaxes(1, 2) @ ((radius - 1.0) / steepness)[..., None]))
    d = d[..., 0]
    change = np.stack([np.stack([d[:, 2], d[:, 4]], axis=1), np.stack([d[:, 4], d[:, 3]], axis=1)], axis=1)
    return centre + d[:, :2], inverse + change @ inverse
