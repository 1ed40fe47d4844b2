"""Detection of a target in grey images: the image positions of its corners."""

from icalib.detection.boards.aprilgrid import AprilGridDetector, MarkerDetector
from icalib.detection.boards.charuco import CharucoDetector
from icalib.detection.boards.checkerboard import CheckerboardDetector
from icalib.detection.boards.diagnosis import what_is_seen
from icalib.detection.primitives.corners import VERDICTS, ImageCorners, corner_stream

__all__ = [
    "VERDICTS",
    "AprilGridDetector",
    "CharucoDetector",
    "CheckerboardDetector",
    "ImageCorners",
    "MarkerDetector",
    "corner_stream",
    "what_is_seen",
]
