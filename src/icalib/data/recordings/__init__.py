"""Recordings of any format: access to images, and reading of checked measurements."""

from icalib.data.images.images import DamagedImageError, DecodedImage, Payload, decode
from icalib.data.recordings.bag import BagRecording
from icalib.data.recordings.base import Recording
from icalib.data.recordings.folder import FolderRecording
from icalib.data.recordings.opening import open_recording, read_measurements
from icalib.data.recordings.pictures import PictureFolder
from icalib.data.topics import TopicInfo

__all__ = [
    "BagRecording",
    "DamagedImageError",
    "FolderRecording",
    "DecodedImage",
    "Payload",
    "PictureFolder",
    "Recording",
    "TopicInfo",
    "decode",
    "open_recording",
    "read_measurements",
]
