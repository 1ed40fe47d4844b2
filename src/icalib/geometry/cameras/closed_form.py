"""Base of camera models whose unprojection has a closed form."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from icalib.geometry.cameras.base import CameraModel

MIN_DISTANCE = 1e-6  # m; closer points have no direction


class ClosedForm(CameraModel):
    """A camera model given by three compiled kernels over contiguous float64 arrays. Each kernel fills its output
    arrays, which are its last arguments."""

    def project(self, params: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        params, points = np.ascontiguousarray(params, float), np.ascontiguousarray(points, float)
        uv, valid = np.empty((len(points), 2)), np.empty(len(points), dtype=np.bool_)
        self._fill_image(params, points, uv, valid)
        return uv, valid

    def project_with_jacobians(
        self, params: np.ndarray, points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        params, points = np.ascontiguousarray(params, float), np.ascontiguousarray(points, float)
        n = len(points)
        uv, valid = np.empty((n, 2)), np.empty(n, dtype=np.bool_)
        j_point, j_params = np.zeros((n, 2, 3)), np.zeros((n, 2, len(params)))
        self._fill_jacobians(params, points, uv, valid, j_point, j_params)
        return uv, valid, j_point, j_params

    def unproject(self, params: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
