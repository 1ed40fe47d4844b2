"""Recordings: what was recorded -> checked measurements."""

from icalib.recordings.base import Recording
from icalib.recordings.folder import FolderRecording, open_recording
from icalib.recordings.reading import read_measurements

__all__ = ["FolderRecording", "Recording", "open_recording", "read_measurements"]
