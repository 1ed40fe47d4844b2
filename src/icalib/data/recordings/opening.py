"""Opens a recording: detects its format and chooses the reader."""

from __future__ import annotations

from math import inf
from pathlib import Path

from icalib.data.bags.opening import bag_files
from icalib.data.images.unreadable import HEAD_BYTES, is_video, not_data
from icalib.data.recordings.bag import BagRecording
from icalib.data.recordings.base import Recording
from icalib.data.recordings.folder import FolderRecording
from icalib.data.recordings.pictures import PictureFolder, has_pictures
from icalib.data.stamps.window import Window
from icalib.data.tables.files import named_tables, table_files
from icalib.errors import RecordingError

_MAX_LISTED = 12
_OF_TABLES = ("*/*.csv", "*/*.csv.gz", "mav0", "*/data")


def open_recording(path: str | Path, start_s: float = 0.0, end_s: float = inf) -> Recording:
    """Open the recording at `path`: a bag, or a folder of bags, of tables (also EuRoC's) or of images.

    The format is detected from the content. start_s, end_s: time window, in seconds from the start of the recording.
    Raises RecordingError if the path is missing or has no known format, or if the window is invalid.
    """
    root, window = Path(path), Window(start_s, end_s)
    if root.is_dir():
        if _holds_bags(root):
            return BagRecording(root, window)
        if _holds_tables(root):
            return FolderRecording(root, window)
        if has_pictures(root):
            return PictureFolder(root, window)
        _refuse_unreadable(root)
        return FolderRecording(root, window)
    if root.exists():
        return BagRecording(root, window)
    parent = root.parent
    beside = sorted(p.name for p in parent.iterdir())[:_MAX_LISTED] if parent.is_dir() else []
    listing = f"{parent} holds {', '.join(beside)}" if beside else f"{parent} is empty or missing"
    raise RecordingError(f"{root} does not exist; {listing}; check the path of the recording.")


def _refuse_unreadable(folder: Path) -> None:
    """Raises RecordingError if a file of `folder` is a pointer of Git LFS or git-annex, or a misnamed video."""
    for path in sorted(p for p in folder.iterdir() if p.is_file() and not is_video(p)):
        with path.open("rb") as file:
            sentence = not_data(path, file.read(HEAD_BYTES))
        if sentence:
            raise RecordingError(sentence)


def _holds_bags(folder: Path) -> bool:
    """True if `folder` has bags and no tables. Tables have priority: they may be extracted from the bag beside them."""
    return bool(bag_files(folder)) and not _holds_tables(folder)


def _holds_tables(folder: Path) -> bool:
    patterns = (*_OF_TABLES, *(f"*/{table.name}" for table in table_files()))
    return any(p for pattern in patterns for p in folder.glob(pattern)) or bool(named_tables(folder))
