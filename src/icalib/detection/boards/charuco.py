"""ChArUco boards: markers identify the corners of the squares, and these corners are measured."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icalib.detection.boards.aprilgrid import all_tags
from icalib.detection.primitives.corners import ImageCorners, no_corners
from icalib.detection.primitives.decoding import mapped
from icalib.detection.primitives.growth import decoded_markers, fit_homography, homography_misfit, largest_group
from icalib.detection.primitives.prediction import PredictedCorners, predict_nodes
from icalib.detection.primitives.squares import square_corners
from icalib.detection.primitives.tags import Family, ImageWithQuads, tag_family
from icalib.errors import RecordingError

_PREDICTING_MARKERS = 4  # markers that predict a corner
_LEAST_TO_TELL = 6  # least number of markers that show whether the layout is right
_LEAST_MARKERS = 2  # markers that must agree: small dictionaries have false detections


@dataclass(frozen=True)
class CharucoDetector:
    """Finds the inner corners of a ChArUco board of `rows` x `cols` squares, with markers in the white ones.

    marker_ratio: edge of a marker over edge of a square. family: dictionary of the markers, with ids from 0 row by row,
    as OpenCV numbers them. legacy: OpenCV's layout before 4.6, which differs if the number of rows is even. Raises
    RecordingError if the dictionary has too few markers or the ratio is impossible, and RigError if the dictionary is
    unknown.
    """

    rows: int
    cols: int
    marker_ratio: float
    family: str
    legacy: bool = False

    def __post_init__(self) -> None:
        n, has = len(self.tag_corners), len(self._family.codes)
        if n > has:
            raise RecordingError(
                f"a ChArUco board of {self.rows} x {self.cols} squares needs {n} markers and {self.family} has {has}; "
                "check rows, cols and family."
            )
        if not 0.0 < self.marker_ratio < 1.0:
            raise RecordingError(
                f"marker_ratio is {self.marker_ratio:g}; give the marker's edge divided by the square's, 0 to 1."
            )

    @cached_property
    def _family(self) -> Family:
        """The bit patterns of the markers."""
        return tag_family(self.family)

    @cached_property
    def _dark(self) -> np.ndarray:
        """(rows, cols) bool, see `dark_squares`."""
        return dark_squares(self.rows, self.cols, self.legacy)

    @cached_property
    def tag_corners(self) -> np.ndarray:
        """(n, 4, 2) corners of the markers, see `charuco_tags`."""
        return charuco_tags(self._dark, self.marker_ratio)

    def detect(self, image: np.ndarray) -> ImageCorners:
        """The board's inner corners in the image (h, w) uint8, numbered row by row from the top left, as in OpenCV.

        Raises RecordingError for an image that is not grey with 8 bits.
        """
        return self.find(ImageWithQuads(image))

    def find(self, view: ImageWithQuads) -> ImageCorners:
        """As `detect`, for an image whose quads may be known already."""
        known, quads = self._unique_markers(view)
        known = largest_group(known, quads, self.tag_corners / self.marker_ratio)
        if known.sum() < _LEAST_MARKERS:
            return no_corners()
        expected = self._expected(self.tag_corners[known], quads[known])
        return square_corners(view.image, expected, self._dark, 0.5 * (1.0 - self.marker_ratio))

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        """As `find`, near predicted corners. None if some that should be in the image are not found, or less than half
        of the markers are."""
        nodes = self._nodes(expected)
        corners = square_corners(view.image, nodes, self._dark, 0.5 * (1.0 - self.marker_ratio))
        if not len(corners.point) or not expected.all_detected(view.image, corners):
            return None
        quads = _in_squares(self._nodes(PredictedCorners(corners.point, corners.uv)), self.tag_corners)
        inside = ((quads > 0.0) & (quads < np.array(view.image.shape[::-1]) - 1.0)).all(axis=(1, 2))
        patterns = np.ascontiguousarray(self._family.codes[: len(quads), 0])
        n_decoded = int(decoded_markers(view.image, quads[inside], patterns[inside], self._family.bits, 1).sum())
        return corners if n_decoded >= max(_LEAST_MARKERS, 0.5 * inside.sum()) else None

    def _nodes(self, corners: PredictedCorners) -> np.ndarray:
        """(rows + 1, cols + 1, 2) px: all corners of the squares, predicted from the inner ones in `corners`."""
        at = np.stack(np.divmod(corners.point, self.cols - 1), axis=1) + 1
        return predict_nodes(at, corners.uv, self.rows + 1, self.cols + 1)

    def misfit(self, view: ImageWithQuads) -> float:
        """Misfit of the markers to the board, see `homography_misfit`; NaN if too few are seen."""
        known, quads = self._unique_markers(view)
        if known.sum() < _LEAST_TO_TELL:
            return float("nan")
        return homography_misfit(self.tag_corners[known], quads[known])

    def _unique_markers(self, view: ImageWithQuads) -> tuple[np.ndarray, np.ndarray]:
        """Which markers (n,) are seen exactly once, and their corners (n, 4, 2) px."""
        n = len(self.tag_corners)
        known, quads = np.zeros(n, dtype=bool), np.zeros((n, 4, 2))
        tags = all_tags(view, self._family, 1)
        ids, count = np.unique(tags.ids, return_counts=True)
        for tag in ids[(count == 1) & (ids < n)]:
            known[tag], quads[tag] = True, tags.quads[tags.ids == tag][0]
        return known, quads

    def _expected(self, markers: np.ndarray, quads: np.ndarray) -> np.ndarray:
        """(rows + 1, cols + 1, 2) px: corners of the squares, predicted by the nearest markers found.

        markers (m, 4, 2) [squares], quads (m, 4, 2) px.
        """
        out = np.empty((self.rows + 1, self.cols + 1, 2))
        centers = markers.mean(axis=1)
        for row in range(self.rows + 1):
            for col in range(self.cols + 1):
                near = np.argsort(((centers - (col, row)) ** 2).sum(axis=1), kind="stable")[:_PREDICTING_MARKERS]
                xy, uv = markers[near].reshape(-1, 2), quads[near].reshape(-1, 2)
                out[row, col] = mapped(fit_homography(xy, uv, len(xy)), float(col), float(row))
        return out


def dark_squares(rows: int, cols: int, legacy: bool) -> np.ndarray:
    """(rows, cols) bool: the dark squares of a ChArUco board, row 0 at the top."""
    row, col = np.indices((rows, cols))
    return (row + col + int(legacy and rows % 2 == 0)) % 2 == 0


def charuco_tags(dark: np.ndarray, marker_ratio: float) -> np.ndarray:
    """(n, 4, 2) corners of the markers in the white squares, clockwise from the top left [squares]; x to the right, y
    down."""
    row, col = np.nonzero(~dark)
    margin = 0.5 * (1.0 - marker_ratio)
    unit = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    return np.stack([col, row], axis=1)[:, None, :] + margin + marker_ratio * unit


def _in_squares(nodes: np.ndarray, markers: np.ndarray) -> np.ndarray:
    """(n, 4, 2) px: corners of the markers (n, 4, 2) [squares], by bilinear interpolation between the corners of the
    squares, (rows + 1, cols + 1, 2) px."""
    col, row = np.floor(markers.mean(axis=1)).astype(np.int64).T
    s, t = (markers - np.stack([col, row], axis=1)[:, None, :]).transpose(2, 0, 1)[..., None]
    a, b, c, d = (
        x[:, None, :] for x in (nodes[row, col], nodes[row, col + 1], nodes[row + 1, col + 1], nodes[row + 1, col])
    )
    return (1.0 - t) * ((1.0 - s) * a + s * b) + t * ((1.0 - s) * d + s * c)
