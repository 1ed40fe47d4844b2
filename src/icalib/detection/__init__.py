"""Detection: grey images -> corners of a target."""

from icalib.detection.aprilgrid import AprilGridDetector
from icalib.detection.charuco import CharucoDetector
from icalib.detection.checkerboard import CheckerboardDetector
from icalib.detection.corners import VERDICTS, ImageCorners, corner_stream
from icalib.detection.diagnosis import what_is_seen
from icalib.detection.markers import MarkerDetector

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
