"""Checkerboards: detection of the inner corners, in an order that does not depend on the orientation of the board."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from icalib.base.extras import load_cv2
from icalib.detection.primitives.corners import INCONSISTENT, ImageCorners, no_corners
from icalib.detection.primitives.crossings import continues_beyond, shows_grid
from icalib.detection.primitives.decoding import nearest_greys
from icalib.detection.primitives.prediction import PredictedCorners, predict_nodes
from icalib.detection.primitives.quads import ImageWithQuads
from icalib.detection.primitives.squares import square_corners
from icalib.errors import RecordingError

_REDUCED_PX = 1000  # larger images are first searched at a fraction of their size; only the time depends on it
# Share of the corners without the outermost that must form a grid; with fewer, there is no thorough search.
_LEAST_CROSSING_SHARE = 0.5
_LEAST_SQUARE_PX = 4  # corners that are closer together merge in the detectors' filters
_LEAST_CORNER_SHARE = 0.5  # share of all corners, and of those of each side, that must be found


@dataclass(frozen=True)
class CheckerboardDetector:
    """Finds the inner corners of a checkerboard that is wholly in the image: `rows` x `cols` corners.

    Corners are numbered row by row. The directions along a row (x) and from row to row (y) turn clockwise. The square
    between the first corners of the first two rows is dark. This order is unique if rows + cols is odd. If it is even,
    the board looks the same after half a turn, and if rows = cols is even, after a quarter turn. Then the order is
    taken whose rows run most to the right.
    """

    rows: int
    cols: int

    def __post_init__(self) -> None:
        if min(self.rows, self.cols) < 3:
            raise RecordingError(
                f"a checkerboard with {self.rows} x {self.cols} inner corners is too small; use one of 3 x 4 or more."
            )

    def detect(self, image: np.ndarray) -> ImageCorners:
        """The board's inner corners in the image (h, w) uint8, numbered row by row.

        Raises RecordingError for an image that is not grey with 8 bits.
        """
        return self.find(ImageWithQuads(image))

    def find(self, view: ImageWithQuads) -> ImageCorners:
        """As `detect`, for an image whose quads may be known already."""
        for grid in self._proposed(view.image):
            corners = self._corners(view.image, grid)
            if self._is_complete(corners):
                return corners
        return no_corners()

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        """As `find`, near predicted corners; None if some that should be in the image are not found. A board that moved
        by two squares looks the same except at its border."""
        at = np.stack(np.divmod(expected.point, self.cols), axis=1)
        corners = self._corners(view.image, predict_nodes(at, expected.uv, self.rows, self.cols))
        return corners if self._is_complete(corners) and expected.all_detected(view.image, corners) else None

    def _is_complete(self, corners: ImageCorners) -> bool:
        """Whether enough corners of the board, and of each of its four sides, are found and consistent."""
        consistent = np.zeros(self.rows * self.cols, dtype=bool)
        consistent[corners.point[corners.verdict != INCONSISTENT]] = True
        board = consistent.reshape(self.rows, self.cols)
        parts = board, board[0], board[-1], board[:, 0], board[:, -1]
        return min(part.mean() for part in parts) >= _LEAST_CORNER_SHARE

    def _corners(self, image: np.ndarray, grid: np.ndarray) -> ImageCorners:
        """The corners of the board at the grid (rows, cols, 2) px; none if the grid is part of a larger board."""
        framed = _framed(grid)
        if continues_beyond(image, framed):
            return no_corners()
        grid = self._ordered(image, grid)
        dark = (np.indices((self.rows + 1, self.cols + 1)).sum(axis=0) % 2 == 0) == _is_dark(image, grid)
        return square_corners(image, _framed(grid), dark, np.inf)

    def _proposed(self, image: np.ndarray) -> Iterator[np.ndarray]:
        """Grids (rows, cols, 2) px by OpenCV's detectors, accurate to about a pixel; the fast detector first.

        The fast detector sometimes takes parts of other patterns for the board. The thorough one is a hundred times as
        slow if there is no board, so it is used only for images with enough X-corners in rows and columns.
        """
        if not self._fits(image.shape):
            return
        reduced, factor = _reduced(image)
        yield from self._quick(reduced, factor)
        if not shows_grid(image, _LEAST_CROSSING_SHARE * (self.rows - 2) * (self.cols - 2)):
            return
        cv2 = load_cv2()
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        cv2.setRNGSeed(0)  # the search is random: its result must not depend on earlier images
        success, corners = cv2.findChessboardCornersSB(image, (self.cols, self.rows), flags=flags)
        if success:
            yield self._grid(corners)
        if factor > 1:
            yield from self._quick(image, 1)

    def _quick(self, image: np.ndarray, factor: int) -> Iterator[np.ndarray]:
        """The grid that OpenCV's older detector finds in an image reduced by `factor`, in pixels of the full image."""
        if not self._fits(image.shape):
            return
        cv2 = load_cv2()
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        cv2.setRNGSeed(0)
        success, corners = cv2.findChessboardCorners(image, (self.cols, self.rows), flags=flags)
        if success:
            yield factor * (self._grid(corners) + 0.5) - 0.5

    def _fits(self, shape: tuple[int, ...]) -> bool:
        """Whether the squares along the board's shorter side can be resolved in an image of `shape` (h, w).

        The smallest image that fits is 16 px wide; OpenCV's older detector raises an error below 15 px.
        """
        return min(shape) >= _LEAST_SQUARE_PX * (min(self.rows, self.cols) + 1)

    def _grid(self, corners: np.ndarray) -> np.ndarray:
        """OpenCV's corners as (rows, cols, 2) px."""
        return np.asarray(corners, dtype=np.float64).reshape(self.rows, self.cols, 2)

    def _ordered(self, image: np.ndarray, grid: np.ndarray) -> np.ndarray:
        """The corners (rows, cols, 2) px, with rows and columns reversed or exchanged as the order of the class
        demands."""
        if _turn(grid) < 0.0:
            grid = grid[:, ::-1]
        turns = [grid, grid[::-1, ::-1]]
        if self.rows == self.cols:
            turns += [np.rot90(grid, 1), np.rot90(grid, 3)]
        dark = [turn for turn in turns if _is_dark(image, turn)]
        return max(dark or turns, key=lambda turned: float((turned[:, -1] - turned[:, 0])[:, 0].sum()))


def _reduced(image: np.ndarray) -> tuple[np.ndarray, int]:
    """The image, reduced if it is large, and the factor by which it was reduced."""
    factor = -(-max(image.shape) // _REDUCED_PX)
    if factor == 1:
        return image, 1
    cv2 = load_cv2()
    height, width = (max(1, side // factor) for side in image.shape)
    cropped = image[: height * factor, : width * factor]
    return cv2.resize(cropped, (width, height), interpolation=cv2.INTER_AREA), factor


def _turn(grid: np.ndarray) -> float:
    """Positive if rows and columns of the grid (r, c, 2) turn clockwise in the image."""
    a, b = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0), grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    return float(a[0] * b[1] - a[1] * b[0])


def _is_dark(image: np.ndarray, grid: np.ndarray) -> bool:
    """Whether the square between the first corners of the first two rows is dark, by the mean of all such squares."""
    center = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    grey = nearest_greys(image, center)
    even = np.indices(grey.shape).sum(axis=0) % 2 == 0
    return bool(grey[even].mean() < grey[~even].mean())


def _framed(grid: np.ndarray) -> np.ndarray:
    """The corners (r, c, 2) with one more row and column extrapolated on each side, the outer corners of the outer
    squares."""
    grid = np.concatenate([2.0 * grid[:1] - grid[1:2], grid, 2.0 * grid[-1:] - grid[-2:-1]])
    return np.concatenate([2.0 * grid[:, :1] - grid[:, 1:2], grid, 2.0 * grid[:, -1:] - grid[:, -2:-1]], axis=1)
