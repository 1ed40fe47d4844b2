"""Interface of the camera models; all other packages use only this class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

MIN_DISTANCE = 1e-6  # m; closer points have no direction


class CameraModel(ABC):
    """A camera model, given by three compiled kernels over contiguous float64 arrays. Each kernel fills its output
    arrays, which are its last arguments. Parameters are (fx, fy, cx, cy, distortion ...).

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

    def project(self, params: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points (N, 3) in the camera frame [m]. Returns uv (N, 2) [px] and valid (N,) bool."""
        params, points = np.ascontiguousarray(params, float), np.ascontiguousarray(points, float)
        uv, valid = np.empty((len(points), 2)), np.empty(len(points), dtype=np.bool_)
        self._fill_image(params, points, uv, valid)
        return uv, valid

    def project_with_jacobians(
        self, params: np.ndarray, points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """uv and valid as from `project`, then d uv / d point (N, 2, 3) [px/m] and d uv / d params (N, 2, P)."""
        params, points = np.ascontiguousarray(params, float), np.ascontiguousarray(points, float)
        n = len(points)
        uv, valid = np.empty((n, 2)), np.empty(n, dtype=np.bool_)
        j_point, j_params = np.zeros((n, 2, 3)), np.zeros((n, 2, len(params)))
        self._fill_jacobians(params, points, uv, valid, j_point, j_params)
        return uv, valid, j_point, j_params

    def central_scale(self, params: np.ndarray) -> float:
        """Scale at the optical axis along u [px/rad]; it differs from fx in some models."""
        return float(self.project_with_jacobians(params, np.array([[0.0, 0.0, 1.0]]))[2][0, 0, 0])

    def unproject(self, params: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rays of pixels uv (N, 2). Returns unit vectors (N, 3) in the camera frame, and valid (N,) bool (pixel in the
        model's range)."""
        params, uv = np.ascontiguousarray(params, float), np.ascontiguousarray(uv, float)
        rays, valid = np.empty((len(uv), 3)), np.empty(len(uv), dtype=np.bool_)
        self._fill_rays(params, uv, rays, valid)
        return rays, valid

    @abstractmethod
    def _fill_image(self, params: np.ndarray, points: np.ndarray, uv: np.ndarray, valid: np.ndarray) -> None: ...

    @abstractmethod
    def _fill_jacobians(
        self,
        params: np.ndarray,
        points: np.ndarray,
        uv: np.ndarray,
        valid: np.ndarray,
        j_point: np.ndarray,
        j_params: np.ndarray,
    ) -> None:
        """Fill uv, valid and both Jacobians. The Jacobians are zero on entry and must stay zero at invalid points."""

    @abstractmethod
    def _fill_rays(self, params: np.ndarray, uv: np.ndarray, rays: np.ndarray, valid: np.ndarray) -> None: ...
