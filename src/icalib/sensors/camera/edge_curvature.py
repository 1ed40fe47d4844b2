"""Corrects corners for the curvature that the lens gives to the edges of squares and tags.

A detector fits the two edges of a corner over some length, as straight lines or with a free curvature. It states this
fitted curvature (zero for straight lines) and the gain [px^2], the derivative of the corner by the curvature of each
edge. The true curvature can be predicted once lens and pose are known:

    uv += gain (predicted curvature - fitted curvature)

To first order, the result is the corner of a fit with known curvature. Without the correction, straight fits in a
distorted image give biased corners; the bias grows with the square of the fitted length.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.geometry.cameras.base import CameraModel
from icalib.optim.state import State
from icalib.sensors.camera.corner_factor import CornerFactor

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
