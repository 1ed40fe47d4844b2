"""Detection: grey images -> corners of a target."""

from icalib.detection.aprilgrid import AprilGridDetector
from icalib.detection.corners import VERDICTS, ImageCorners, corner_stream

__all__ = ["VERDICTS", "AprilGridDetector", "ImageCorners", "corner_stream"]
