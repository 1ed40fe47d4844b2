"""Recordings: what was recorded -> images, and checked measurements."""

from icalib.recordings.bag import BagRecording
from icalib.recordings.base import Recording
from icalib.recordings.folder import FolderRecording
from icalib.recordings.images import DamagedImageError, Frame, Payload, decode
from icalib.recordings.opening import open_recording
from icalib.recordings.pictures import PictureFolder
from icalib.recordings.reading import read_measurements
from icalib.recordings.topics import TopicInfo, image_topics

__all__ = [
    "BagRecording",
    "DamagedImageError",
    "FolderRecording",
    "Frame",
    "Payload",
    "PictureFolder",
    "Recording",
    "TopicInfo",
    "decode",
    "image_topics",
    "open_recording",
    "read_measurements",
]
