"""How the target departs from what it was drawn as, and where its bloom points."""

from __future__ import annotations

import numpy as np

from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.targets import Target
from icalib.rig.scene import BOW_LABELS, IN_PLANE_LABELS, SHAPE_LABELS

# Priors: boards are flat to a few millimetres, and printed true to about one.
SHAPE_SIGMA_M = np.array([3e-3] * len(BOW_LABELS) + [1e-3] * len(IN_PLANE_LABELS))


def shape_basis(target: Target, bent: bool) -> np.ndarray:
    """(n_points, s, 3) displacement in the frame of each point's body by unit of the body's shape parameters [m]; zeros
    for bodies that do not bend, s = 0 where none may."""
    if not (bent and target.bends.any()):
        return np.zeros((len(target.points), 0, 3))
    basis = np.zeros((len(target.points), len(SHAPE_LABELS), 3))
    for k in np.flatnonzero(target.bends):
        own = target.body == k
        basis[own] = _basis_of_one(target.points[own, :2])
    return basis


def _basis_of_one(xy: np.ndarray) -> np.ndarray:
    """(n, s, 3) of the body with points xy (n, 2).

    With x and y from -1 to 1 over it: the bow z = a x^2 + b x y + c y^2; stretch (x, -y) and shear (y, x); and x or y
    moved by x^2, x y, y^2.
    """
    low, high = xy.min(axis=0), xy.max(axis=0)
    x, y = ((xy - 0.5 * (low + high)) / (0.5 * (high - low))).T
    o = np.zeros_like(x)
    squares = (x * x, x * y, y * y)
    fields = [(o, o, q) for q in squares] + [(x, -y, o), (y, x, o)]
    for q in squares:
        fields += [(q, o, o), (o, q, o)]
    return np.stack([np.stack(f, axis=1) for f in fields], axis=1)


def bloom_direction(model: CameraModel, params: np.ndarray, X: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """(N, 2) unit image direction of `towards` (N, 3, camera axes) at points X (N, 3) in the camera frame."""
    _, valid, J, _ = model.project_with_jacobians(params, X)
    d = np.einsum("nij,nj->ni", J, towards)
    norm = np.linalg.norm(d, axis=1)
    ok = valid & (norm > 0.0)
    return np.where(ok[:, None], d / np.where(ok, norm, 1.0)[:, None], 0.0)
