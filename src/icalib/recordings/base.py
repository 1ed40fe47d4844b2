"""What the rest of the program knows of a recording: this class and nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from icalib.geometry.targets import Target
from icalib.measurements import CornerStream, ImuStream


class Recording(Protocol):
    """One recording. A reader knows its format only; `read_measurements` checks what the numbers must satisfy."""

    def imu(self, path_hint: str, name: str) -> ImuStream:
        """All readings of the IMU `name` as they were written: stamps may still repeat or run backwards.

        Raises RecordingError naming file and line where the data are missing or cannot be read.
        """
        ...

    def corners(self, path_hint: str, name: str, target: Target) -> CornerStream:
        """All corners that the camera `name` saw, grouped by image, images in order.

        Raises RecordingError naming file and line or instant where the data are missing or cannot be read, where images
        are out of order, where a corner appears twice in an image, and where it is not on the target.
        """
        ...

    def where(self, path_hint: str) -> str:
        """How a sentence names the place of a sensor's data, for example the file."""
        ...

    def files(self) -> list[Path]:
        """The files that have been read so far, each once, in the order of reading."""
        ...
