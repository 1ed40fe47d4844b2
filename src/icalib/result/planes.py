"""Planes of the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Plane:
    """A plane of the scene on which LiDAR points lie, in the world frame. normal: unit vector (3,); point: (3,) a point
    on the plane [m]; count: number of points on it, over all LiDARs."""

    name: str
    normal: np.ndarray
    point: np.ndarray
    count: int
