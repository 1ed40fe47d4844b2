"""Grids of circles: OpenCV proposes the grid, then a blurred ellipse is fitted to the edge of each circle.

The centre of that ellipse is not the projected centre of the circle; `estimation/circle_centres.py` corrects it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from icalib.detection.consistency import consistent_corners
from icalib.detection.corners import ImageCorners, judged, no_corners
from icalib.detection.ellipse_model import fit_ellipses
from icalib.detection.quads import View
from icalib.extras import load_cv2
from icalib.geometry.targets import Circles

_LEAST_DIAMETER_PX = 6.0
_MOST_DIAMETER = 0.25  # of the image's shorter side: larger circles are not looked for
_LEAST_FOUND = 0.5  # of the proposed circles, with an ellipse at a consistent place: otherwise it is no grid
_THRESHOLD_STEP = 10  # grey levels; a blob must show at two thresholds, so its contrast must be twice that


@dataclass(frozen=True)
class CirclesDetector:
    """Finds the centres of the circles of `target`, all of which must be in the image."""

    target: Circles

    def detect(self, image: np.ndarray) -> ImageCorners:
        """The centres of the ellipses in the image (h, w) uint8, numbered as `Circles.points`.

        Raises RecordingError for an image that is not grey with 8 bits.
        """
        return self.find(View(image))

    def find(self, view: View) -> ImageCorners:
        """As `detect`."""
        grid = self._proposed(view.image)
        if grid is None:
            return no_corners()
        point = self._numbers(grid)
        uv = np.empty((len(point), 2))
        uv[point] = grid.reshape(-1, 2)
        axes = _projected_radii(self.target.points[:, :2], self.target.diameter, uv)
        fine, quality = fit_ellipses(view.image, uv, axes)
        found = np.isfinite(quality[0])
        board = self.target.points[:, :2] / self.target.spacing
        consistent = consistent_corners(fine, board, found, quality[4], view.image.shape)
        if (found & consistent).mean() < _LEAST_FOUND:
            return no_corners()
        return judged(np.arange(len(fine)), fine, quality, consistent)

    def _proposed(self, image: np.ndarray) -> np.ndarray | None:
        """(rows, cols, 2) px of OpenCV's detector, to about a pixel; None where it finds none."""
        if _MOST_DIAMETER * min(image.shape) < _LEAST_DIAMETER_PX:
            return None  # too small for any circle; OpenCV refuses the contradicting limits
        cv2 = load_cv2()
        size = (self.target.cols, self.target.rows)
        kind = cv2.CALIB_CB_ASYMMETRIC_GRID if self.target.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
        for extra in (0, cv2.CALIB_CB_CLUSTERING):
            blobs = _blob_detector(cv2, image.shape)
            found, centres = cv2.findCirclesGrid(image, size, flags=kind | extra, blobDetector=blobs)
            if found:
                return np.asarray(centres, dtype=np.float64).reshape(self.target.rows, self.target.cols, 2)
        return None

    def _numbers(self, grid: np.ndarray) -> np.ndarray:
        """(n,) number of the target's point at each place of `grid` (rows, cols, 2) px, flattened.

        OpenCV may return the grid turned or mirrored. Numberings that mirror the target are excluded. No image tells
        the others apart: the one whose rows run most to the right is taken.
        """
        number = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
        if not self.target.asymmetric:
            orders = [number, number[::-1], number[:, ::-1], number[::-1, ::-1]]
            orders += [order.T for order in orders] if grid.shape[0] == grid.shape[1] else []
        else:  # an asymmetric grid equals its mirror image where rows are odd, itself after half a turn where even
            orders = [number, number[::-1] if self.target.rows % 2 == 1 else number[::-1, ::-1]]
        return max((order.ravel() for order in orders), key=lambda order: self._to_the_right(grid, order))

    def _to_the_right(self, grid: np.ndarray, order: np.ndarray) -> float:
        """Cosine between the target's x in the image and u, by an affine fit; -2 where the order mirrors the target."""
        xy = np.column_stack([self.target.points[order, :2], np.ones(len(order))])
        A = np.linalg.lstsq(xy, grid.reshape(-1, 2), rcond=None)[0]
        mirrored = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0] > 0.0  # y goes up the sheet and down the image
        return -2.0 if mirrored else float(A[0, 0] / np.linalg.norm(A[0]))


def _blob_detector(cv2: Any, shape: tuple[int, ...]) -> Any:
    """OpenCV's blob detector for dark, convex blobs of 6 px to a quarter of the image (h, w).

    Oblique circles must pass: circularity is not asked for, and the ratio of inertia may be as small as 0.03, that of
    an ellipse seen at 80 degrees.
    """
    params = cv2.SimpleBlobDetector_Params()
    params.thresholdStep = _THRESHOLD_STEP
    params.minThreshold, params.maxThreshold = 10, 245
    params.filterByArea = True
    params.minArea = 0.25 * np.pi * _LEAST_DIAMETER_PX**2
    params.maxArea = 0.25 * np.pi * (_MOST_DIAMETER * min(shape)) ** 2
    params.minDistBetweenBlobs = 0.5 * _LEAST_DIAMETER_PX
    params.filterByColor, params.blobColor = True, 0
    params.filterByCircularity = False
    params.filterByInertia, params.minInertiaRatio = True, 0.03
    params.filterByConvexity, params.minConvexity = True, 0.8
    return cv2.SimpleBlobDetector_create(params)


def _projected_radii(xy: np.ndarray, diameter: float, uv: np.ndarray) -> np.ndarray:
    """(n, 2, 2) px: in its rows, the images of each circle's radii along x and y of the target.

    xy (n, 2) and `diameter` [m] are the target's; uv (n, 2) px are its centres in the image. The affine map about each
    centre comes from the five centres nearest to it on the target.
    """
    out = np.empty((len(xy), 2, 2))
    for i in range(len(xy)):
        near = np.argsort(((xy - xy[i]) ** 2).sum(axis=1), kind="stable")[1:6]
        A = np.linalg.lstsq(xy[near] - xy[i], uv[near] - uv[i], rcond=None)[0]
        out[i] = 0.5 * diameter * A
    return out
