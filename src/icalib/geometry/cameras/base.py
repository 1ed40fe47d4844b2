"""What the rest of the program knows of a camera model: this class and nothing else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np


class CameraModel(ABC):
    """A camera model: compiled functions over arrays of points. Parameters are (fx, fy, cx, cy, distortion ...).

    `valid` marks points that the model can see (in front of the camera, where the model asks for it, and inside the
    range where the image moves outwards as the ray turns away from the axis); what is computed for the others is finite
    but meaningless. Parameters outside the model's domain see less, or nothing, but raise no error.

    start_distortions: where to start when nothing is known of the lens; each is all that follows fx, fy, cx, cy.
    distortion_scale: typical size of its coefficients, over that of a polynomial's; tolerances and guesses scale with
    it.
    """

    name: ClassVar[str]
    parameter_names: ClassVar[tuple[str, ...]]
    start_distortions: ClassVar[tuple[tuple[float, ...], ...]]
    distortion_scale: ClassVar[float] = 1.0

    @abstractmethod
    def project(self, params: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 3) in the camera frame [m] -> uv (N, 2) [px], valid (N,) bool."""

    @abstractmethod
    def project_with_jacobians(
        self, params: np.ndarray, points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """uv and valid as `project`, then d uv / d point (N, 2, 3) and d uv / d params (N, 2, P)."""

    def central_scale(self, params: np.ndarray) -> float:
        """Pixels per radian in the image's centre, along u: not fx in every model."""
        return float(self.project_with_jacobians(params, np.array([[0.0, 0.0, 1.0]]))[2][0, 0, 0])

    @abstractmethod
    def unproject(self, params: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """uv (N, 2) [px] -> unit rays (N, 3) in the camera frame, valid (N,) bool (inside the model's range)."""
