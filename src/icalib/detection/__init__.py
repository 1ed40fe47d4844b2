"""Detection of a target in grey images: the image positions of its corners."""

from icalib.detection.checkerboard import CheckerboardDetector
from icalib.detection.decoding import VERDICTS, ImageCorners, corner_stream
from icalib.detection.detectors import what_is_seen
from icalib.detection.tag_boards import AprilGridDetector, CharucoDetector, MarkerDetector

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
