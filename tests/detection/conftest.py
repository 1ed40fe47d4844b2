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


def homography(
    pattern: Pattern, distance: float, tilt_deg: float, turn_deg: float, roll_deg: float, offset, y_up: bool = True
) -> np.ndarray:
    """Board -> pixels: its middle `distance` away and `offset` px from the image's, tilted about an axis at `turn`."""
    tilt, turn, roll = np.radians([tilt_deg, turn_deg, roll_deg])
    about_z = lambda a: np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])  # noqa: E731
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(tilt), -np.sin(tilt)], [0.0, np.sin(tilt), np.cos(tilt)]])
    facing = np.diag([1.0, -1.0, -1.0]) if y_up else np.eye(3)
    R = about_z(turn) @ about_x @ about_z(-turn) @ about_z(roll) @ facing
    t = distance * np.array([offset[0] / K[0, 0], offset[1] / K[1, 1], 1.0])
    middle = 0.5 * pattern.cell * np.array(pattern.white.shape[::-1])
    from_middle = np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, 1.0]])
    return K @ np.stack([R[:, 0], R[:, 1], t], axis=1) @ from_middle


def applied(H: np.ndarray, points: np.ndarray) -> np.ndarray:
    p = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ H.T
    return p[:, :2] / p[:, 2:]


@njit
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


def aprilgrid(
    rows: int, cols: int, border: int = 2, gap: int = 3, squares: bool = True, size: float = 0.088
) -> Pattern:
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


def charuco(rows: int, cols: int, family: str = "4X4_50", square: float = 0.06) -> Pattern:
    """OpenCV's board as OpenCV draws it, markers two cells smaller than squares; x to the right, y down."""
    cv2 = pytest.importorskip("cv2")
    source = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}"))
    n = source.markerSize + 4
    board = cv2.aruco.CharucoBoard((cols, rows), float(n), float(n - 2), source)
    white = board.generateImage((n * cols, n * rows), None, 0, 1) > 127
    points = np.asarray(board.getChessboardCorners())[:, :2].astype(float) * square / n
    return Pattern(white, square / n, points, points + 0.5 * square)


def checkerboard(rows: int, cols: int, square: float = 0.06) -> Pattern:
    """`rows` x `cols` inner corners; the square between the first four of them is dark; x to the right, y down."""
    row, col = np.indices((rows + 1, cols + 1))
    y, x = np.indices((rows, cols)).reshape(2, -1) + 1
    points = square * np.stack([x, y], axis=1).astype(float)
    return Pattern((row + col) % 2 == 1, square, points, points + 0.5 * square)


def markers(family: str, ids: list[int], border: int, size: float = 0.15) -> Pattern:
    """Tags in a row with gaps of their own size, as icalib numbers their corners: x to the right, y up."""
    bits = [marker_cells(family, tag, border) for tag in ids]
    n = len(bits[0])
    white = np.ones((3 * n, (2 * len(ids) + 1) * n), dtype=bool)
    points, centers = [], []
    for i, cells in enumerate(bits):
        x = (2 * i + 1) * n
        white[n : 2 * n, x : x + n] = (np.rot90(cells, 2) if family.startswith("APRILTAG") else cells)[::-1]
        points += [(x, n), (x + n, n), (x + n, 2 * n), (x, 2 * n)]
        centers += 4 * [(x + n / 2, 1.5 * n)]
    cell = size / n
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
        homography=homography,
        render=render,
        errors=errors,
        applied=applied,
        aprilgrid=aprilgrid,
        charuco=charuco,
        checkerboard=checkerboard,
        markers=markers,
    )
    return SimpleNamespace(Pattern=Pattern, size=SIZE, **functions)
