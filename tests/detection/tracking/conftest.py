"""Images of a far scene from a camera that turns: each pixel's place in every image is known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

SIZE = (320, 240)
IMAGES = 20
_K = np.array([[250.0, 0.0, 159.5], [0.0, 250.0, 119.5], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Turning:
    """images (h, w) uint8, and the homography (3, 3) from the first to each."""

    images: list[np.ndarray]
    homographies: list[np.ndarray]

    def moved(self, uv: np.ndarray, image: int) -> np.ndarray:
        """(n, 2) where pixels uv (n, 2) of the first image are in another."""
        p = np.column_stack([uv, np.ones(len(uv))]) @ self.homographies[image].T
        return p[:, :2] / p[:, 2:]


def turning(texture: np.ndarray, beside: np.ndarray | None = None, seed: int = 5) -> Turning:
    """Turns of up to 1.5 deg an image about all axes, seen through the texture of a far wall; the second of two cameras
    sees at `beside` (3, 3) times its pixel what the first sees there."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float64)
    pixels = np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
    images, homographies = [], []
    for k in range(IMAGES):
        x, y, z = 0.1 * np.sin(0.25 * k), 0.08 * np.sin(0.2 * k), 0.15 * np.sin(0.17 * k)
        # Exponential of a small turn by its series: an obvious formula, and not the program's.
        W = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        R = sum((np.linalg.matrix_power(W, n) / float(np.prod(np.arange(1, n + 1))) for n in range(1, 10)), np.eye(3))
        H = _K @ R @ np.linalg.inv(_K)
        H = H if beside is None else beside @ H
        at = np.linalg.inv(H) @ pixels
        grey = map_coordinates(texture, [at[1] / at[2] + 200.0, at[0] / at[2] + 200.0], order=3, mode="nearest")
        images.append(np.clip(np.rint(grey + rng.normal(size=grey.shape)), 0, 255).reshape(v.shape).astype(np.uint8))
        homographies.append(H)
    return Turning(images, homographies)


def wall(seed: int) -> np.ndarray:
    texture = gaussian_filter(np.random.default_rng(seed).normal(size=(700, 800)), 2.5)
    return 128.0 + 30.0 * texture / texture.std()


@pytest.fixture(scope="package")
def scene() -> Turning:
    return turning(wall(3))
