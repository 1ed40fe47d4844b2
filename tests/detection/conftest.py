"""Images of a flat pattern under a pinhole camera, with truth: obvious, slow, and independent of icalib."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from numba import njit
from scipy.ndimage import gaussian_filter

SIZE = (752, 480)
K = np.array([[460.0, 0.0, 375.5], [0.0, 460.0, 239.5], [0.0, 0.0, 1.0]])
GREYS = (40.0, 200.0)  # black and white


@dataclass(frozen=True)
class Pattern:
    """A pattern of square cells: white (rows, cols) bool; `cell` is the edge of one, row 0 at the smallest y.

    The centre of the board is at the middle of the pattern, x along a row, y along a column; points (n, 2) in the same
    axes, from the corner of the pattern.
    """

    white: np.ndarray
    cell: float
    points: np.ndarray
    centers: np.ndarray  # (n, 2) of the dark square to which each point belongs


def homography(pattern: Pattern, distance: float, tilt_deg: float, turn_deg: float, roll_deg: float, offset) -> np.ndarray:
    """Board -> pixels: the board's middle at `distance`, `offset` px from the image's, tilted about an axis at `turn`."""
    tilt, turn, roll = np.radians([tilt_deg, turn_deg, roll_deg])
    about_z = lambda a: np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])  # noqa: E731
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(tilt), -np.sin(tilt)], [0.0, np.sin(tilt), np.cos(tilt)]])
    facing = np.diag([1.0, -1.0, -1.0])  # y of the board up in the image, z towards the camera
    R = about_z(turn) @ about_x @ about_z(-turn) @ about_z(roll) @ facing
    t = distance * np.array([offset[0] / K[0, 0], offset[1] / K[1, 1], 1.0])
    middle = 0.5 * pattern.cell * np.array(pattern.white.shape[::-1])
    from_middle = np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, 1.0]])
    return K @ np.stack([R[:, 0], R[:, 1], t], axis=1) @ from_middle


def applied(H: np.ndarray, points: np.ndarray) -> np.ndarray:
    p = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ H.T
    return p[:, :2] / p[:, 2:]


@njit(cache=True)
def _painted(white, inverse, cell, width, height, margin, black_level, white_level, background):
    image = np.empty((height, width))
    for v in range(height):
        for u in range(width):
            total = 0.0
            for i in range(8):
                for j in range(8):
                    x = u - 0.5 + (j + 0.5) / 8.0
                    y = v - 0.5 + (i + 0.5) / 8.0
                    w = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
                    col = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) / w / cell
                    row = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) / w / cell
                    if 0.0 <= col < white.shape[1] and 0.0 <= row < white.shape[0]:
                        total += white_level if white[int(row), int(col)] else black_level
                    elif -margin <= col < white.shape[1] + margin and -margin <= row < white.shape[0] + margin:
                        total += white_level
                    else:
                        total += background
            image[v, u] = total / 64.0
    return image


def render(pattern: Pattern, H: np.ndarray, blur: float = 0.9, noise: float = 2.0, seed: int = 0, margin: float = 4.0):
    """(480, 752) uint8. The pattern is printed on white paper, `margin` cells wider than it."""
    # With t in front of the camera the denominator is positive where the board is seen.
    inverse = np.linalg.inv(H)
    image = _painted(pattern.white, inverse, pattern.cell, *SIZE, margin, *GREYS, 110.0)
    image = gaussian_filter(image, blur) if blur > 0.0 else image
    image += noise * np.random.default_rng(seed).standard_normal(image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def marker_cells(family: str, tag: int, border: int) -> np.ndarray:
    """(n, n) bool, white cells of one tag in OpenCV's orientation, top row first."""
    cv2 = pytest.importorskip("cv2")
    source = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}"))
    n = source.markerSize + 2 * border
    return source.generateImageMarker(tag, n, None, border) > 127


def aprilgrid(rows: int, cols: int, border: int = 2, gap: int = 3, squares: bool = True, size: float = 0.088) -> Pattern:
    """Kalibr's grid: tag 0 at the origin, x to the right, y up; `gap` in cells."""
    n = 6 + 2 * border
    pitch = n + gap
    white = np.ones((rows * pitch + gap, cols * pitch + gap), dtype=bool)
    points, centers = [], []
    cell = size / n
    for row in range(rows):
        for col in range(cols):
            # The picture of an AprilTag by OpenCV stands on its head, and its first row is the highest y.
            bits = np.rot90(marker_cells("APRILTAG_36H11", row * cols + col, border), 2)[::-1]
            y, x = gap + row * pitch, gap + col * pitch
            white[y : y + n, x : x + n] = bits
            points += [(x, y), (x + n, y), (x + n, y + n), (x, y + n)]
            centers += 4 * [(x + n / 2, y + n / 2)]
    if squares:
        for row in range(rows + 1):
            for col in range(cols + 1):
                white[row * pitch : row * pitch + gap, col * pitch : col * pitch + gap] = False
    return Pattern(white, cell, cell * np.array(points, dtype=float), cell * np.array(centers))


@dataclass(frozen=True)
class Errors:
    """Errors (n, 2) px of corners, and their share towards the centre of their square."""

    uv: np.ndarray
    inward: np.ndarray

    @property
    def rms(self) -> float:
        return float(np.sqrt((self.uv**2).mean()))


def errors(pattern: Pattern, H: np.ndarray, point: np.ndarray, uv: np.ndarray) -> Errors:
    truth, center = applied(H, pattern.points)[point], applied(H, pattern.centers)[point]
    inward = (center - truth) / np.linalg.norm(center - truth, axis=1, keepdims=True)
    return Errors(uv - truth, ((uv - truth) * inward).sum(axis=1))


@pytest.fixture(scope="session")
def rendering() -> SimpleNamespace:
    """The functions of this file, for tests are not a package."""
    functions: dict[str, Callable] = dict(
        homography=homography, render=render, aprilgrid=aprilgrid, errors=errors, applied=applied, marker=marker_cells
    )
    return SimpleNamespace(Pattern=Pattern, size=SIZE, **functions)
