"""Grids of circles: their centres, each that of an ellipse fitted to the circle's edge."""

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
_LARGEST_SHARE = 0.25  # of the image's shorter side: the diameter of a circle
_LEAST_FOUND = 0.5  # of the circles that OpenCV proposes: others are no grid
_STEPS = 10  # grey levels between the thresholds of the blob detector


@dataclass(frozen=True)
class CirclesDetector:
    """Finds the centres of the circles of `target`, all of which must be in the image."""

    target: Circles

    def detect(self, image: np.ndarray) -> ImageCorners:
        """The centres in the image (h, w) uint8, as points of the target.

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
        axes = _axes(self.target.points[:, :2], self.target.diameter, uv)
        fine, quality = fit_ellipses(view.image, uv, axes)
        found = np.isfinite(quality[0])
        board = self.target.points[:, :2] / self.target.spacing
        consistent = consistent_corners(fine, board, found, quality[4], view.image.shape)
        if (found & consistent).mean() < _LEAST_FOUND:
            return no_corners()
        return judged(np.arange(len(fine)), fine, quality, consistent)

    def _proposed(self, image: np.ndarray) -> np.ndarray | None:
        """(rows, cols, 2) px of OpenCV's detector, to about a pixel; None where it finds none."""
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
        """(n,) the target's point of each circle of the grid, in an order that does not mirror the target. Of orders
        that images do not tell apart it is the one whose rows run most to the right."""
        number = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
        if not self.target.asymmetric:
            orders = [number, number[::-1], number[:, ::-1], number[::-1, ::-1]]
            orders += [order.T for order in orders] if grid.shape[0] == grid.shape[1] else []
        else:  # with an odd number of rows the mirrored print is the same, else the one after half a turn
            orders = [number, number[::-1] if self.target.rows % 2 == 1 else number[::-1, ::-1]]
        return max((order.ravel() for order in orders), key=lambda order: self._to_the_right(grid, order))

    def _to_the_right(self, grid: np.ndarray, order: np.ndarray) -> float:
        """How far to the right an affine map takes the target's x, over the length; -2 where it mirrors the target."""
        xy = np.column_stack([self.target.points[order, :2], np.ones(len(order))])
        A = np.linalg.lstsq(xy, grid.reshape(-1, 2), rcond=None)[0]
        mirrored = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0] > 0.0  # y goes up the sheet and down the image
        return -2.0 if mirrored else float(A[0, 0] / np.linalg.norm(A[0]))


def _blob_detector(cv2: Any, shape: tuple[int, ...]) -> Any:
    """OpenCV's, for dark round blobs of any size that circles may have."""
    params = cv2.SimpleBlobDetector_Params()
    params.thresholdStep = _STEPS
    params.minThreshold, params.maxThreshold = 10, 245
    params.filterByArea = True
    params.minArea = 0.25 * np.pi * _LEAST_DIAMETER_PX**2
    params.maxArea = 0.25 * np.pi * (_LARGEST_SHARE * min(shape)) ** 2
    params.minDistBetweenBlobs = 0.5 * _LEAST_DIAMETER_PX
    params.filterByColor, params.blobColor = True, 0
    params.filterByCircularity = False
    params.filterByInertia, params.minInertiaRatio = True, 0.03
    params.filterByConvexity, params.minConvexity = True, 0.8
    return cv2.SimpleBlobDetector_create(params)


def _axes(xy: np.ndarray, diameter: float, uv: np.ndarray) -> np.ndarray:
    """(n, 2, 2) px: the images of a circle's radii along x and y, from the centres nearest to each on the target."""
    out = np.empty((len(xy), 2, 2))
    for i in range(len(xy)):
        near = np.argsort(((xy - xy[i]) ** 2).sum(axis=1), kind="stable")[1:6]
        A = np.linalg.lstsq(xy[near] - xy[i], uv[near] - uv[i], rcond=None)[0]
        out[i] = 0.5 * diameter * A
    return out
