"""Corners moved to where they lie on edges that are bent as the lens bends them.

A detector fits the two edges of a corner over some length, as straight ones or with a curvature of its own, and says by
how much the corner moves with each edge's curvature. Once lens and pose are known, so is the curvature:

    uv += gain (predicted curvature - fitted curvature)

To first order that is the corner of a fit in which the curvature is fixed. The bias without it is that of straight
edges in a distorted image; it grows with the square of the length that was fitted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.estimation.corner_factor import CornerFactor
from icalib.estimation.state import State
from icalib.geometry.cameras.base import CameraModel

LEAST_AREA = 1e-6  # of the square of the focal length: a plane seen from its edge has no image


def with_bent_edges(factor: CornerFactor, state: State) -> CornerFactor:
    """The factor with its corners moved to where they lie as lens and poses of `state` bend their edges."""
    if not len(factor.stream.edges):
        return factor
    uv = factor.stream.uv.copy()
    params = np.concatenate([state.values[factor.name, "intrinsics"], state.values[factor.name, "distortion"]])
    for v0, v1 in factor.blocks():
        own = factor.corners_of(v0, v1)
        X, R_cam_body = factor.points_in_camera(state, v0, v1)
        plane = R_cam_body[factor.views.of_corners(v0, v1) - v0, :, :2]
        for edge in factor.stream.edges[own].transpose(1, 0, 2):
            fitted = edge.astype(np.float64)
            curvature, known = predicted_curvature(factor.model, params, X, plane, fitted[:, :4].reshape(-1, 2, 2))
            uv[own] += np.where(known, curvature - fitted[:, 6], 0.0)[:, None] * fitted[:, 4:6]
    return replace(factor, stream=replace(factor.stream, uv=uv))


def predicted_curvature(
    model: CameraModel, params: np.ndarray, X: np.ndarray, plane: np.ndarray, piece: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) curvature [1 / px] of a straight piece of the target in the image, and whether (n,) it is known.

    X (n, 3) m: the corners in the camera's frame; plane (n, 3, 2): the body's axes x and y there; piece (n, 2, 2) px:
    from and to, beside the corner. It is the second difference over both ends and the middle.
    """
    _, valid, J_point, _ = model.project_with_jacobians(params, X)
    A = J_point @ plane
    area = np.linalg.det(A)
    known = valid & (np.abs(area * X[:, 2] ** 2) > LEAST_AREA * params[0] ** 2)
    inverse = np.linalg.inv(np.where(known[:, None, None], A, np.eye(2)))
    uv = []
    for beside in (piece[:, 0], piece.mean(axis=1), piece[:, 1]):
        point = X + np.einsum("nij,njk,nk->ni", plane, inverse, beside)
        place, valid = model.project(params, point)
        known &= valid
        uv.append(place)
    chord = uv[2] - uv[0]
    bend = uv[0] + uv[2] - 2.0 * uv[1]
    square = (chord**2).sum(axis=1)
    known &= square > 0.0
    across = chord[:, 1] * bend[:, 0] - chord[:, 0] * bend[:, 1]
    return across / np.where(known, 0.25 * square**1.5, 1.0), known
