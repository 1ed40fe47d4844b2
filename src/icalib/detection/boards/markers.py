"""Free markers: tags of a family that are surrounded by white, with four L-corners each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icalib.detection.primitives.corners import CROWDED, ImageCorners, no_corners, with_verdicts
from icalib.detection.primitives.families import Family, tag_family
from icalib.detection.primitives.quads import ImageWithQuads
from icalib.detection.primitives.refinement import refined_corners
from icalib.detection.primitives.tags import Tags, tags_at
from icalib.errors import RecordingError

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
