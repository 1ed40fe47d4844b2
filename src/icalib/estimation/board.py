"""How the target departs from what it was drawn as, and where its bloom points."""

from __future__ import annotations

import numpy as np

from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.targets import AprilGrid

SHAPE_LABELS = ("bow_xx", "bow_xy", "bow_yy")


def shape_basis(target: AprilGrid, bends: bool) -> np.ndarray:
    """(n_points, s, 3) displacement in the board frame by unit of each shape parameter [m].

    The bow: z = a x^2 + b x y + c y^2, with x and y from -1 to 1 over the target.
    """
    if not bends:
        return np.zeros((len(target.points), 0, 3))
    xy = target.points[:, :2]
    low, high = xy.min(axis=0), xy.max(axis=0)
    x, y = ((xy - 0.5 * (low + high)) / (0.5 * (high - low))).T
    basis = np.zeros((len(xy), len(SHAPE_LABELS), 3))
    for k, f in enumerate((x * x, x * y, y * y)):
        basis[:, k, 2] = f
    return basis


def bloom_direction(
    model: CameraModel, params: np.ndarray, X: np.ndarray, towards: np.ndarray
) -> np.ndarray:
    """(N, 2) unit image direction of `towards` (N, 3, camera axes) at points X (N, 3) in the camera frame."""
    _, valid, J, _ = model.project_with_jacobians(params, X)
    d = np.einsum("nij,nj->ni", J, towards)
    norm = np.linalg.norm(d, axis=1)
    ok = valid & (norm > 0.0)
    return np.where(ok[:, None], d / np.where(ok, norm, 1.0)[:, None], 0.0)
