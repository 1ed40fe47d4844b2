"""Checkerboards: the inner corners, in an order that does not depend on how the board is held."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.detection.corners import ImageCorners, no_corners
from icalib.detection.quads import View
from icalib.detection.squares import square_corners
from icalib.errors import RecordingError
from icalib.extras import load_cv2


@dataclass(frozen=True)
class CheckerboardDetector:
    """Finds the inner corners, `rows` x `cols` of them, of a checkerboard that is wholly in the image.

    Corners are numbered row by row, x along a row and y from row to row turning with the clock, and the square between
    the first corners of the first two rows is dark. That is unique where rows + cols is odd. Where it is even the board
    looks the same upside down, and a RecordingError is raised, unless `upright` promises that the board is always held
    with its rows running to the right, within 90 degrees, or 45 where rows = cols.
    """

    rows: int
    cols: int
    upright: bool = False

    def __post_init__(self) -> None:
        if min(self.rows, self.cols) < 3:
            raise RecordingError(
                f"a checkerboard with {self.rows} x {self.cols} inner corners is too small; use one of 3 x 4 or more."
            )
        if (self.rows + self.cols) % 2 == 0 and not self.upright:
            raise RecordingError(
                f"a checkerboard with {self.rows} x {self.cols} inner corners looks the same upside down; use one with "
                "an odd and an even number, or state that it is always held upright."
            )

    def detect(self, image: np.ndarray) -> ImageCorners:
        """The board's inner corners in the image (h, w) uint8, numbered row by row.

        Raises RecordingError for an image that is not grey with 8 bits.
        """
        return self.find(View(image))

    def find(self, view: View) -> ImageCorners:
        """As `detect`."""
        image = view.image
        cv2 = load_cv2()
        found, corners = cv2.findChessboardCornersSB(image, (self.cols, self.rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return no_corners()
        grid = self._ordered(image, np.asarray(corners, dtype=np.float64).reshape(self.rows, self.cols, 2))
        dark = (np.indices((self.rows + 1, self.cols + 1)).sum(axis=0) % 2 == 0) == _is_dark(image, grid, 0, 0)
        return square_corners(image, _framed(grid), dark, np.inf)

    def _ordered(self, image: np.ndarray, grid: np.ndarray) -> np.ndarray:
        """The corners (rows, cols, 2) px with rows and columns reversed where they must be."""
        if _turn(grid) < 0.0:
            grid = grid[:, ::-1]
        if not self.upright:
            return grid if _is_dark(image, grid, 0, 0) else grid[::-1, ::-1]
        turns = [grid, grid[::-1, ::-1]]
        if self.rows == self.cols:
            turns += [np.rot90(grid, 1), np.rot90(grid, 3)]
        return max(turns, key=lambda turned: float((turned[:, -1] - turned[:, 0])[:, 0].sum()))


def _turn(grid: np.ndarray) -> float:
    """Positive where rows and columns of the grid (r, c, 2) turn with the clock in the image."""
    a, b = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0), grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    return float(a[0] * b[1] - a[1] * b[0])


def _is_dark(image: np.ndarray, grid: np.ndarray, row: int, col: int) -> bool:
    """Whether the square between the corners (row, col) and (row + 1, col + 1) is darker than its neighbours."""
    center = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    u, v = np.round(center).astype(np.int64).transpose(2, 0, 1)
    grey = image[v.clip(0, image.shape[0] - 1), u.clip(0, image.shape[1] - 1)].astype(np.float64)
    even = np.indices(grey.shape).sum(axis=0) % 2 == (row + col) % 2
    return bool(grey[even].mean() < grey[~even].mean())


def _framed(grid: np.ndarray) -> np.ndarray:
    """The corners (r, c, 2) with one more row and column on each side, where the outer squares end."""
    grid = np.concatenate([2.0 * grid[:1] - grid[1:2], grid, 2.0 * grid[-1:] - grid[-2:-1]])
    return np.concatenate([2.0 * grid[:, :1] - grid[:, 1:2], grid, 2.0 * grid[:, -1:] - grid[:, -2:-1]], axis=1)
