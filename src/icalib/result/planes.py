"""Planes of the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Plane:
    """A plane that points of LiDARs lie on. World frame: unit normal (3,) and a point (3,) on it [m]; count: of points,
    all LiDARs together."""

    name: str
    normal: np.ndarray
    point: np.ndarray
    count: int
