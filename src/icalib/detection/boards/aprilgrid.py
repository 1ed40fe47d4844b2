"""AprilGrids: tags are decoded, further tags are found from these, corners are refined and compared with their
neighbours.

Free markers: tags of a family that are surrounded by white, with four L-corners each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icalib.detection.primitives.corners import CROWDED, ImageCorners, no_corners, with_verdicts
from icalib.detection.primitives.growth import (
    confirm,
    consistent_corners,
    grow,
    largest_group,
    refined_corners,
    refined_crossings,
)
from icalib.detection.primitives.prediction import PredictedCorners
from icalib.detection.primitives.tags import Family, ImageWithQuads, Tags, find_tags, tag_family, tags_at
from icalib.errors import RecordingError
from icalib.geometry.targets.families import APRILGRID_FAMILY

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
