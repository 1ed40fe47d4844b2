"""Grids of circles: dark ellipses are assigned to the grid, then a blurred ellipse is fitted to the edge of each.

The centre of this ellipse is not the projected centre of the circle; `sensors/camera/circle_centres.py` corrects it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.detection.boards.circle_grid import dark_ellipses, find_grids, step_of
from icalib.detection.primitives.consistency import consistent_corners
from icalib.detection.primitives.corners import ImageCorners, no_corners, with_verdicts
from icalib.detection.primitives.ellipse_model import fit_ellipses
from icalib.detection.primitives.prediction import PredictedCorners
from icalib.detection.primitives.quads import ImageWithQuads
from icalib.geometry.targets import Circles

# Share of the circles that need an ellipse at a consistent position; with fewer, there is no grid.
_LEAST_CIRCLE_SHARE = 0.5


@dataclass(frozen=True)
class CirclesDetector:
    """Finds the centres of the circles of `target`, all of which must be in the image."""

    target: Circles

    def detect(self, image: np.ndarray) -> ImageCorners:
        """The centres of the ellipses in the image (h, w) uint8, numbered as `Circles.points`.

        Raises RecordingError for an image that is not grey with 8 bits.
        """
        return self.find(ImageWithQuads(image))

    def find(self, view: ImageWithQuads) -> ImageCorners:
        """As `detect`, for an image whose quads may be known already."""
        for window in view.windows:
            grids = find_grids(self.target, dark_ellipses(view.image, window, step_of(self.target)))
            if grids:
                # The image does not distinguish the rotations: the one whose rows run most to the right is taken.
                centres = self._centres(view.image, max(grids, key=self._to_the_right))
                if len(centres.point):
                    return centres
        return no_corners()

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        """As `find`, near predicted centres of all circles; None if one is not predicted or not found."""
        if len(expected.point) < len(self.target.points):
            return None
        centres = self._centres(view.image, expected.uv)
        return centres if expected.all_detected(view.image, centres) else None

    def _centres(self, image: np.ndarray, uv: np.ndarray) -> ImageCorners:
        """Centres of the ellipses near uv (n, 2) px; none if fewer than _LEAST_CIRCLE_SHARE are found and
        consistent."""
        axes = _projected_radii(self.target.points[:, :2], self.target.diameter, uv)
        fine, quality = fit_ellipses(image, uv, axes)
        valid = np.isfinite(quality[0])
        board = self.target.points[:, :2] / self.target.spacing
        consistent = consistent_corners(fine, board, valid, quality[4], image.shape)
        if (valid & consistent).mean() < _LEAST_CIRCLE_SHARE:
            return no_corners()
        return with_verdicts(np.arange(len(fine)), fine, quality, consistent)

    def _to_the_right(self, uv: np.ndarray) -> float:
        """Cosine between the target's x in the image and u, by an affine fit to the centres uv (n, 2) px."""
        xy = np.column_stack([self.target.points[:, :2], np.ones(len(uv))])
        A = np.linalg.lstsq(xy, uv, rcond=None)[0]
        return float(A[0, 0] / np.linalg.norm(A[0]))


def _projected_radii(xy: np.ndarray, diameter: float, uv: np.ndarray) -> np.ndarray:
    """(n, 2, 2) px: in its rows, the images of each circle's radii along x and y of the target.

    xy (n, 2) and `diameter` [m]: of the target; uv (n, 2) px: centres in the image. The affine map about each centre is
    fitted to the five centres nearest to it on the target.
    """
    out = np.empty((len(xy), 2, 2))
    for i in range(len(xy)):
        near = np.argsort(((xy - xy[i]) ** 2).sum(axis=1), kind="stable")[1:6]
        A = np.linalg.lstsq(xy[near] - xy[i], uv[near] - uv[i], rcond=None)[0]
        out[i] = 0.5 * diameter * A
    return out
