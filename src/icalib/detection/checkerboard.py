"""Checkerboards: detection of the inner corners, in an order that does not depend on the orientation of the board.

X-corners of any pattern: whether an image shows a grid of them, and whether a grid continues beyond a board.

X-corners are found by the ChESS response (Bennett and Lasenby, Computer Vision and Image Understanding 118, 2014).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import hypot

import numpy as np
from scipy.sparse.csgraph import connected_components

from icalib.base.compiled import njit
from icalib.base.extras import load_cv2
from icalib.detection.decoding import INCONSISTENT, ImageCorners, nearest_greys, no_corners
from icalib.detection.edge_model import USUAL_BLUR_PX
from icalib.detection.growth import PredictedCorners, predict_nodes, square_corners
from icalib.detection.saddles import crossing_contrast, find_saddle
from icalib.detection.tags import LEAST_CONTRAST, ImageWithQuads
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


# Half of the 16 samples of ChESS, (u, v) px from a pixel; the other half lies opposite.
_RING = ((0, -5), (2, -5), (3, -3), (5, -2), (5, 0), (5, 2), (3, 3), (2, 5))
_RING_PX = 5
_SCALES = 3  # levels of the image pyramid; one more finds boards that are twice as blurred
# Grey levels. A sharp corner of contrast c has up to 8 c. Doubled, a blurred board of the least contrast is missed.
_LEAST_RESPONSE = 4 * LEAST_CONTRAST
_PEAK_WINDOW_PX = 7  # width of the non-maximum suppression; corners less than 4 px apart merge
_MOST_PEAKS = 500  # strongest peaks of an image that are kept; the time grows with its square
_NEIGHBOUR_PEAKS = 8  # peaks among which a corner's grid neighbours are looked for: four, and four diagonal ones
# Largest |p + q| / min(|p|, |q|) of two opposite neighbours at p and q from the corner: 0 without perspective and
# distortion. If it were larger, random texture would have opposite neighbours by chance.
_OPPOSITE = 0.25
_LEAST_SINE = 0.3  # of the angle between rows and columns in the image, at least: 17 degrees
_MOST_MOVE = 0.2  # of a square's side: largest distance of a corner from its extrapolated position
_CLEAR = 0.5  # of a square's side: largest half width of the window
_CONTINUED_SHARE = 0.5  # share of extrapolated positions beside a board with X-corners, above which the board is larger


def shows_grid(image: np.ndarray, enough: float) -> bool:
    """Whether the image (h, w) uint8, at full, half or quarter size, has a grid of `enough` connected X-corners."""
    cv2 = load_cv2()
    for _ in range(_SCALES):
        if min(image.shape) <= 2 * _RING_PX:
            break  # no pixel has a whole ring
        response = _chess_response(image)
        largest_near = cv2.dilate(response, np.ones((_PEAK_WINDOW_PX, _PEAK_WINDOW_PX)))
        peak = (response == largest_near) & (response > _LEAST_RESPONSE)
        at = np.argwhere(peak)
        strongest = np.argsort(-response[peak], kind="stable")[:_MOST_PEAKS]
        if _largest_grid(at[strongest].astype(np.float64)) >= enough:
            return True
        if min(image.shape) < 8 * _RING_PX:
            break
        image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return False


def _largest_grid(at: np.ndarray) -> int:
    """Number of the points at (n, 2) px in the largest connected part of the graph of `_grid_links`."""
    if len(at) <= _NEIGHBOUR_PEAKS:
        return 0
    links = _grid_links(at)
    inner = links.any(axis=1)
    links = links[np.ix_(inner, inner)]
    _, group = connected_components(links | links.T, directed=False)
    return int(np.bincount(group, minlength=1).max())


@njit(cache=True, nogil=True)
def _grid_links(at):
    """(n, n) bool: [i, j] is true if point j of at (n, 2) px is a grid neighbour of point i.

    A grid point has pairs of opposite neighbours in two directions. Points without two directions get no links.
    """
    n = len(at)
    links, distance = np.zeros((n, n), dtype=np.bool_), np.empty(n)
    for i in range(n):
        for j in range(n):
            distance[j] = hypot(at[j, 0] - at[i, 0], at[j, 1] - at[i, 1])
        near = np.argsort(distance)[1 : _NEIGHBOUR_PEAKS + 1]
        first = -1
        for a in range(_NEIGHBOUR_PEAKS):
            for b in range(a + 1, _NEIGHBOUR_PEAKS):
                p, q = at[near[a]] - at[i], at[near[b]] - at[i]
                if hypot(p[0] + q[0], p[1] + q[1]) > _OPPOSITE * min(distance[near[a]], distance[near[b]]):
                    continue
                links[i, near[a]] = links[i, near[b]] = True
                if first < 0:
                    first = near[a]
        second_direction = False
        for j in near:
            if links[i, j]:
                p, q = at[j] - at[i], at[first] - at[i]
                cross = abs(p[0] * q[1] - p[1] * q[0])
                second_direction |= cross > _LEAST_SINE * distance[j] * distance[first]
        if not second_direction:
            links[i] = False
    return links


def _chess_response(image: np.ndarray) -> np.ndarray:
    """(h - 10, w - 10) float32: ChESS response [grey levels] of the image (h, w), without a border of 5 px.

    At an X-corner, opposite samples of the ring are equal, and samples a quarter turn apart differ. The mean of the
    ring equals that of the centre. The response is the sum response minus the difference and mean responses.
    """
    grey = load_cv2().GaussianBlur(image, (0, 0), 1.0).astype(np.int16)
    h, w = grey.shape

    def moved(dx: int, dy: int) -> np.ndarray:
        return grey[_RING_PX + dy : h - _RING_PX + dy, _RING_PX + dx : w - _RING_PX + dx]

    pairs = [(moved(dx, dy), moved(-dx, -dy)) for dx, dy in _RING]
    sums = [a + b for a, b in pairs]
    crossed = sum(np.abs(sums[k] - sums[k + 4]).astype(np.int32) for k in range(4))
    unlike = sum(np.abs(a - b).astype(np.int32) for a, b in pairs)
    middle = sum(moved(dx, dy).astype(np.int32) for dx, dy in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)))
    off = np.abs(sum(s.astype(np.int32) for s in sums) - 16 * middle // 5)
    return (crossed - unlike - off).astype(np.float32)


def continues_beyond(image: np.ndarray, framed: np.ndarray) -> bool:
    """Whether the pattern continues beyond a side of the board: X-corners are at more than half of the extrapolated
    positions there. A search for a small board must not accept a part of a larger one.

    framed (rows + 2, cols + 2, 2) px: the inner corners, and a row or column extrapolated beyond each side.
    """
    for turned in (framed, framed[::-1], framed.swapaxes(0, 1), framed.swapaxes(0, 1)[::-1]):
        beside, inner = turned[0], turned[1, 1:-1]
        along = 0.5 * (beside[2:] - beside[:-2])
        if _crossings(image, beside[1:-1].copy(), along, inner - beside[1:-1]) > _CONTINUED_SHARE * len(inner):
            return True
    return False


@njit(cache=True, nogil=True)
def _crossings(image, at, ea, eb):
    """Number of X-corners near the points at (n, 2) px; ea and eb (n, 2) px: along their edges, one square long."""
    count = 0
    for i in range(len(at)):
        most = _MOST_MOVE * min(hypot(ea[i, 0], ea[i, 1]), hypot(eb[i, 0], eb[i, 1])) + 1.0
        has_saddle, u, v = find_saddle(image, at[i, 0], at[i, 1], ea[i], eb[i], _CLEAR, USUAL_BLUR_PX, most)
        if has_saddle:
            contrast = crossing_contrast(image, u, v, ea[i], eb[i], _CLEAR, USUAL_BLUR_PX)
            if max(contrast, crossing_contrast(image, u, v, -ea[i], eb[i], _CLEAR, USUAL_BLUR_PX)) >= LEAST_CONTRAST:
                count += 1
    return count
