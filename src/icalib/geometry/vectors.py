"""Cross products of many vectors, and a comparison of vectors."""

from __future__ import annotations

import numpy as np

MEDIAN_NORM = 1.538  # median length of a vector with three standard normal components


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(..., 3) cross products of a and b (..., 3), which are broadcast. For a few hundred vectors it is several times
    faster than numpy.cross."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        np.multiply(a[..., j], b[..., k], out=out[..., i])
        out[..., i] -= a[..., k] * b[..., j]
    return out


def is_near(a: np.ndarray, b: np.ndarray, share: float) -> bool:
    """Whether the norm of a - b is smaller than `share` times the norm of b."""
    return float(np.linalg.norm(a - b)) < share * float(np.linalg.norm(b))
