"""How large the errors of corners are, judged from what a pass leaves behind.

    sigma_i^2 = base^2 + (exposure v_i)^2        image i moving at v_i px/s: blur
    an error shared by all corners of an image: a field (1, x, y) of the image, N(0, tau^2) each, u and v apart

Everything is estimated with medians, so that outliers have no say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.estimation.corner_factor import CornerFactor, CornerNoise, CornerOutput
from icalib.estimation.state import State
from icalib.rig import Camera, Settings

MEDIAN_OF_CHI2_2 = 2.0 * np.log(2.0)
SMALLEST_PX = 0.01
FIRST_GUESS_PX = 0.5
BINS = 12  # of image speed


@dataclass(frozen=True)
class NoiseModel:
    """One camera's corner noise: base [px], exposure [s], tau (m,) [px]."""

    base: float
    exposure: float
    tau: np.ndarray

    def of(self, factor: CornerFactor | None, n_images: int, speed: np.ndarray | None) -> np.ndarray:
        """(M,) sigma of each image."""
        del factor
        v = np.zeros(n_images) if speed is None else speed
        return np.hypot(self.base, self.exposure * v)


def image_speed(factor: CornerFactor, state: State) -> np.ndarray:
    """(M,) px/s, RMS over the corners of each image."""
    X, _ = factor.points_in_camera(state)
    poses, _, _ = factor.camera_poses(state)
    R_ic, p_ic = state.values[factor.name, "rotation"], state.values[factor.name, "translation"]
    rate = poses.rate @ R_ic
    velocity = np.einsum("nji,nj->ni", poses.rotation, poses.velocity) + np.cross(poses.rate, p_ic)
    image = factor.stream.image
    X_dot = -np.cross(rate[image], X) - (velocity @ R_ic)[image]
    params = np.concatenate([state.values[factor.name, "intrinsics"], state.values[factor.name, "distortion"]])
    _, _, J, _ = factor.model.project_with_jacobians(params, X)
    flow = np.einsum("nij,nj->ni", J, X_dot)
    return np.sqrt(_image_mean(factor, (flow**2).sum(axis=1)))


def _image_mean(factor: CornerFactor, x: np.ndarray) -> np.ndarray:
    start = factor.stream.start
    total = np.add.reduceat(np.append(x, 0.0), np.minimum(start[:-1], len(x)))
    count = np.diff(start)
    return np.where(count > 0, total / np.maximum(count, 1), 0.0)
