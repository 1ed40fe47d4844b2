"""The detector of each target."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from icalib.detection.aprilgrid import AprilGridDetector
from icalib.detection.charuco import CharucoDetector
from icalib.detection.checkerboard import CheckerboardDetector
from icalib.detection.corners import ImageCorners
from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Target


class Detector(Protocol):
    """Finds one target in images."""

    def detect(self, image: np.ndarray) -> ImageCorners:
        """Corners in the image (h, w) uint8, indices into the target's points."""
        ...


def detector_of(target: Target) -> Detector:
    """The detector that finds `target`. Raises RigError for one that none finds in images."""
    if isinstance(target, AprilGrid):
        return AprilGridDetector(
            target.rows, target.cols, target.tag_spacing, border_bits=target.border_bits, squares=target.squares
        )
    if isinstance(target, Charuco):
        ratio = target.marker_size / target.square_size
        return CharucoDetector(target.squares_y, target.squares_x, ratio, target.dictionary)
    if isinstance(target, Checkerboard):
        return CheckerboardDetector(target.rows, target.cols)
    raise RigError(f"targets of type {target.type} are not found in images; use corners as a table.")
