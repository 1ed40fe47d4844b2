"""Edge bloom: the apparent shift of dark edges in the image, caused by blur and by the response of the camera."""

from __future__ import annotations

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
