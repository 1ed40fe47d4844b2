"""Permutation and signs of vector components as the rig file states."""

from __future__ import annotations

import numpy as np

from icalib.rig import Axes


def in_axes(values: np.ndarray, axes: Axes | None) -> np.ndarray:
    """Vectors (N, 3) with components reordered and negated by `axes`, the source components of x, y and z, such as
    ("y", "-x", "z"). Unchanged if `axes` is None."""
    if axes is None:
        return values
    columns = ["xyz".index(entry[-1]) for entry in axes]
    return values[:, columns] * [-1.0 if entry.startswith("-") else 1.0 for entry in axes]
