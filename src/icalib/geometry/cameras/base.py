"""Interface of the camera models; all other packages use only this class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np


class CameraModel(ABC):
    """A camera model, with compiled functions over arrays of points. Parameters are (fx, fy, cx, cy, distortion ...).

    `valid` marks points that the model can project. They are within the monotonic range, where the image radius grows
    with the angle to the axis, and in front of the camera if the model requires it. Values at invalid points are finite
    but meaningless. Parameters outside the model's domain make points invalid and raise no error.

    start_distortions: initial distortions for an unknown lens; each contains all parameters after fx, fy, cx, cy.
    distortion_scale: typical size of the coefficients relative to those of a polynomial model; tolerances and initial
    guesses scale with it.
    """

    name: ClassVar[str]
    parameter_names: ClassVar[tuple[str, ...]]
    start_distortions: ClassVar[tuple[tuple[float, ...], ...]]
    distortion_scale: ClassVar[float] = 1.0

    @abstractmethod
    def project(self, params: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points (N, 3) in the camera frame [m]. Returns uv (N, 2) [px] and valid (N,) bool."""

    @abstractmethod
    def project_with_jacobians(
        self, params: np.ndarray, points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """uv and valid as from `project`, then d uv / d point (N, 2, 3) [px/m] and d uv / d params (N, 2, P)."""

    def central_scale(self, params: np.ndarray) -> float:
        """Scale at the optical axis along u [px/rad]; it differs from fx in some models."""
        return float(self.project_with_jacobians(params, np.array([[0.0, 0.0, 1.0]]))[2][0, 0, 0])

    @abstractmethod
    def unproject(self, params: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rays of pixels uv (N, 2). Returns unit vectors (N, 3) in the camera frame, and valid (N,) bool (pixel in the
        model's range)."""
