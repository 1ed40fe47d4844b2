"""Corners of AprilGrids and ChArUco boards in an image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icalib.detection.decoding import CROWDED, ImageCorners, mapped, no_corners, with_verdicts
from icalib.detection.growth import (
    PredictedCorners,
    confirm,
    consistent_corners,
    decoded_markers,
    fit_homography,
    grow,
    homography_misfit,
    largest_group,
    predict_nodes,
    refined_corners,
    refined_crossings,
    square_corners,
)
from icalib.detection.tags import Family, ImageWithQuads, Tags, find_tags, tag_family, tags_at
from icalib.errors import RecordingError
from icalib.geometry.targets.families import APRILGRID_FAMILY

# AprilGrids: tags are decoded, further tags are found from these, corners are refined and compared with their
# neighbours.
#
# Free markers: tags of a family that are surrounded by white, with four L-corners each.

# corners of a tag in OpenCV's order, in tag sizes
_ON_BOARD = np.array([(1.0, 0.0), (0.0, 0.0), (0.0, 1.0), (1.0, 1.0)])


@dataclass(frozen=True)
class AprilGridDetector:
    """Finds the corners of an AprilGrid of `rows` x `cols` tags with gaps of `tag_spacing` tag sizes.

    border_bits: width of the tags' black border in cells, 2 for Kalibr's grids, 1 for plain tags. squares: whether
    black squares fill the gaps between the tags' corners, as on Kalibr's grids. first_id: id of the first tag. Raises
    RecordingError if the family has too few ids, and RigError if it is unknown.
    """

    rows: int
    cols: int
    tag_spacing: float
    family: str = APRILGRID_FAMILY
    border_bits: int = 2
    squares: bool = True
    first_id: int = 0

    def __post_init__(self) -> None:
        n = len(self._family.codes)
        if self.first_id + self.rows * self.cols > n:
            raise RecordingError(
                f"an AprilGrid of {self.rows} x {self.cols} tags needs more ids than {self.family} has ({n}); "
                "check rows, cols, first_id and family."
            )

    @cached_property
    def _family(self) -> Family:
        """The bit patterns of the tags."""
        return tag_family(self.family)

    @cached_property
    def tag_corners(self) -> np.ndarray:
        """(n, 4, 2) corners of the tags, see `grid_tags`."""
        return grid_tags(self.rows, self.cols, self.tag_spacing)

    @property
    def _border(self) -> float:
        """Width of the black border in tag sizes."""
        return self.border_bits / (self._family.bits + 2 * self.border_bits)

    @property
    def _clear(self) -> float:
        """Distance from a corner to the nearest other feature, in tag sizes."""
        return min(self._border, self.tag_spacing)

    def detect(self, image: np.ndarray) -> ImageCorners:
        """The grid's corners in the image (h, w) uint8, corner c of tag i as point 4 i + c.

        Raises RecordingError for an image that is not grey with 8 bits.
        """
        return self.find(ImageWithQuads(image))

    def find(self, view: ImageWithQuads) -> ImageCorners:
        """As `detect`, for an image whose quads may be known already."""
        for window in view.windows:
            for separate in (True, False):
                tags = find_tags(view, self._family, self.border_bits, window, separate)
                known, quads = self._seeds(tags)
                if known.any():
                    # Tags are located again, so that the result does not depend on how they were found.
                    confirm(view.image, known, quads, *self._cells, self._clear, self.squares)
                    return self._corners(view.image, known, quads)
        return no_corners()

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        """As `find`, near predicted corners; None if some that should be in the image are not found."""
        n = self.rows * self.cols
        uv, predicted = np.zeros((4 * n, 2)), np.zeros(4 * n, dtype=bool)
        uv[expected.point], predicted[expected.point] = expected.uv, True
        of_tag = 4 * np.arange(n)[:, None] + APRILTAG_CORNER
        known, quads = predicted[of_tag].all(axis=1), uv[of_tag]
        known = largest_group(
            confirm(view.image, known, quads, *self._cells, self._clear, self.squares), quads, self.tag_corners
        )
        if not known.any():
            return None
        # Tags at the image border may be missing, so the margin is the side of a tag.
        side = float(np.linalg.norm(quads[known, 1] - quads[known, 0], axis=1).max())
        corners = self._corners(view.image, known, quads)
        return corners if expected.all_detected(view.image, corners, side) else None

    @cached_property
    def _cells(self) -> tuple[np.ndarray, int, int]:
        """Patterns (n,) uint64 of the board's tags, data cells along a side, and width of their border in cells."""
        last = self.first_id + self.rows * self.cols
        return np.ascontiguousarray(self._family.codes[self.first_id : last, 0]), self._family.bits, self.border_bits

    def _seeds(self, tags: Tags) -> tuple[np.ndarray, np.ndarray]:
        """(known (n,) bool, quads (n, 4, 2)) of the tags of the board that predict each other's positions."""
        n = self.rows * self.cols
        known, quads = np.zeros(n, dtype=bool), np.zeros((n, 4, 2))
        place = tags.ids - self.first_id
        places, count = np.unique(place, return_counts=True)
        for tag in places[(count == 1) & (places >= 0) & (places < n)]:
            known[tag], quads[tag] = True, tags.quads[place == tag][0]
        return largest_group(known, quads, self.tag_corners), quads

    def _corners(self, image: np.ndarray, known: np.ndarray, quads: np.ndarray) -> ImageCorners:
        """Refined corners of the known tags, and of further tags that are found from these."""
        grow(image, known, quads, self.tag_corners, self.cols, *self._cells, self._clear, self.squares)
        tags = np.flatnonzero(known)
        if self.squares:
            uv, quality = refined_crossings(image, quads[tags], np.array([self.tag_spacing, self._border, np.inf]))
        else:
            uv, quality = refined_corners(image, quads[tags], self._clear)
        uv, quality = uv.reshape(-1, 2), quality.reshape(len(quality), -1)
        point = (4 * tags[:, None] + APRILTAG_CORNER).ravel()
        board, valid = self.tag_corners[tags].reshape(-1, 2), np.isfinite(quality[0])
        consistent = consistent_corners(uv, board, valid, quality[4], image.shape)
        return with_verdicts(point, uv, quality, consistent, np.inf if self.squares else CROWDED)


def grid_tags(rows: int, cols: int, tag_spacing: float) -> np.ndarray:
    """(n, 4, 2) corners of the tags in OpenCV's order, in tag sizes; x to the right, y up."""
    row, col = np.divmod(np.arange(rows * cols), cols)
    return (1.0 + tag_spacing) * np.stack([col, row], axis=1)[:, None, :] + _ON_BOARD


# Corner number in icalib (from the lower left of the tag's picture, counterclockwise) of each corner in OpenCV's order.
# OpenCV's pictures of AprilTags are rotated by 180 deg.
APRILTAG_CORNER = np.array([1, 0, 3, 2])
ARUCO_CORNER = np.array([3, 2, 1, 0])


def all_tags(view: ImageWithQuads, family: Family, border_bits: int) -> Tags:
    """Tags of the family that are surrounded by white, of any size."""
    quads = np.concatenate([view.quads(window, False) for window in view.windows])
    return tags_at(view.image, quads, family, border_bits)


@dataclass(frozen=True)
class MarkerDetector:
    """Finds tags of `family` that are surrounded by white, with a black border of `border_bits` cells.

    ids: those to find; corner c of ids[i] is point 4 i + c. Corners are numbered from the lower left of the tag's
    picture counterclockwise, as on an AprilGrid. Raises RecordingError for an unknown or repeated id, and RigError for
    an unknown family.
    """

    family: str
    ids: tuple[int, ...]
    border_bits: int = 1

    def __post_init__(self) -> None:
        n = len(self._family.codes)
        for tag in self.ids:
            if not 0 <= tag < n or self.ids.count(tag) > 1:
                raise RecordingError(
                    f"id {tag} is not one of {self.family} (0 to {n - 1}) or is listed twice; correct the list of ids."
                )

    @cached_property
    def _family(self) -> Family:
        """The bit patterns of the tags."""
        return tag_family(self.family)

    def detect(self, image: np.ndarray) -> ImageCorners:
        """The markers' corners in the image (h, w) uint8; a marker that is seen twice is left out.

        Raises RecordingError for an image that is not grey with 8 bits.
        """
        return self.find(ImageWithQuads(image))

    def find(self, view: ImageWithQuads) -> ImageCorners:
        """As `detect`, for an image whose quads may be known already."""
        tags = all_tags(view, self._family, self.border_bits)
        ids, count = np.unique(tags.ids, return_counts=True)
        rows = np.flatnonzero(np.isin(tags.ids, ids[count == 1]) & np.isin(tags.ids, self.ids))
        if not len(rows):
            return no_corners()
        clear = self.border_bits / (self._family.bits + 2 * self.border_bits)
        uv, quality = refined_corners(view.image, tags.quads[rows], clear)
        order = APRILTAG_CORNER if self._family.is_apriltag else ARUCO_CORNER
        place = np.array([self.ids.index(int(tag)) for tag in tags.ids[rows]])
        point = (4 * place[:, None] + order).ravel()
        consistent = np.ones(len(point), dtype=bool)
        return with_verdicts(point, uv.reshape(-1, 2), quality.reshape(len(quality), -1), consistent, CROWDED)


# ChArUco boards: markers identify the corners of the squares, and these corners are measured.

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
