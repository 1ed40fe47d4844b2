"""Planes of the scene as arrays for compiled kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.geometry.planes import tangents
from icalib.optim.state import Key, State


class Planes(NamedTuple):
    """P planes in the world: unit normal (P, 3), tangents (P, 2, 3) across it, and a point (P, 3) on each [m]. columns
    (P, 3): calibration columns, -1 where fixed."""

    normal: np.ndarray
    tangents: np.ndarray
    point: np.ndarray
    columns: np.ndarray

    @classmethod
    def of(cls, keys: tuple[Key, ...], state: State, columns: np.ndarray) -> Planes:
        """Planes `keys` with their values in `state`."""
        value = np.array([state.values[key] for key in keys])
        across = np.array([tangents(v[:3]) for v in value])
        return cls(value[:, :3].copy(), across, value[:, 3:].copy(), columns)
