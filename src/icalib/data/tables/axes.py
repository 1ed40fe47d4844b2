"""Vectors in the axes that the rig file gives."""

from __future__ import annotations

import numpy as np

from icalib.rig import Axes


def in_axes(values: np.ndarray, axes: Axes | None) -> np.ndarray:
    """Vectors (N, 3) of the columns that become x, y and z, with their signs; as they are without `axes`."""
    if axes is None:
        return values
    columns = ["xyz".index(entry[-1]) for entry in axes]
    return values[:, columns] * [-1.0 if entry.startswith("-") else 1.0 for entry in axes]
