"""Recordings of any format: access to images, and reading of checked measurements."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import inf
from pathlib import Path

from icalib.base.files import HEAD_BYTES, is_video, not_data
from icalib.data.bag_recording import BagRecording, GrowingBag, bag_files
from icalib.data.folder import FolderRecording, GrowingFolder, PictureFolder, has_pictures
from icalib.data.images import DamagedImageError, DecodedImage, Payload, decode
from icalib.data.measurements import Measurements
from icalib.data.messages import TopicInfo
from icalib.data.recording import Growing, Progress, Reading, Recording
from icalib.data.stamps import LONGEST_S, ClockJumps, S, Window
from icalib.data.tables import named_tables, table_files
from icalib.errors import CalibrationError, RecordingError
from icalib.kinds import readers
from icalib.rig import Rig

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


# Opens a recording: detects its format and chooses the reader.
#
# Opens several recordings of a rig under unique names; adds names and notes to errors. Reads and checks the
# measurements of all sensors of a rig from a recording.

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


def open_growing_recording(path: Path) -> Growing | None:
    """The recording that is being written at `path`; None while nothing is there."""
    if path.is_file() or (path.is_dir() and bag_files(path)):
        return GrowingBag(path)
    tables_or_sensors = path.is_dir() and any(p.is_dir() or p.suffix == ".csv" for p in path.iterdir())
    return GrowingFolder(path) if tables_or_sensors else None


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


Source = Recording | str | Path


def open_all(given: Source | Sequence[Source], start_s: float = 0.0, end_s: float = inf) -> dict[str, Recording]:
    """Opened recordings by name: the name of the file or folder, or the whole path if two share the name.

    An already opened `Recording` is numbered. start_s, end_s: time window of each, as in `open_recording`. Raises
    RecordingError for no recording, an unreadable one, a path given twice, and a time window with an opened
    `Recording`.
    """
    sources: Sequence[Source] = given if isinstance(given, Sequence) and not isinstance(given, str) else [given]
    if not sources:
        raise RecordingError("no recording was given; give at least one.")
    paths = [Path(s).resolve() for s in sources if isinstance(s, (str, Path))]
    twice = [path for path, count in Counter(paths).items() if count > 1]
    if twice:
        raise RecordingError(f"the recording {twice[0]} is given twice; give each recording once.")
    names = Counter(path.name for path in paths)
    opened: dict[str, Recording] = {}
    for k, source in enumerate(sources, 1):
        if isinstance(source, (str, Path)):
            path = Path(source).resolve()
            opened[path.name if names[path.name] == 1 else str(path)] = open_recording(source, start_s, end_s)
        elif (start_s, end_s) != (0.0, inf):
            raise RecordingError("start_s and end_s do not apply to an opened recording; give them to open_recording.")
        else:
            opened[f"recording {k}"] = source
    return opened


@contextmanager
def naming(name: str) -> Iterator[None]:
    """Context manager: prefixes errors raised within by `name`, unless it is empty or the message contains it."""
    try:
        yield
    except CalibrationError as error:
        if not name or re.search(rf"(^|[/\\]){re.escape(name)}\b", str(error)):
            raise
        raise type(error)(f"{name}: {error}") from error


@contextmanager
def noting(notes: Iterable[str]) -> Iterator[None]:
    """Context manager: adds `notes` on rejected or repaired data, a possible cause, to `__notes__` of errors raised
    within."""
    try:
        yield
    except CalibrationError as error:
        for note in dict.fromkeys(notes):
            error.add_note(note)
        raise


def read_measurements(recording: Recording, rig: Rig, progress: Progress = lambda *_: None) -> Measurements:
    """Read and check the streams of all sensors of `rig` from `recording`. If a sensor recorded images, target corners
    or feature tracks are detected in them.

    Clock jumps split a stream; one segment is used. Notes list rejected data. Raises RecordingError, naming the file
    and line or instant, for data that are missing, unreadable, unordered, in wrong units, or not of this rig.
    """
    progress("reading", 0.0)
    recording.use_layouts(tuple(rig.sensors.values()))
    jumps = ClockJumps(LONGEST_S)
    reading = Reading(rig, _uncut if rig.cameras_alone else jumps.cut, progress)
    streams = []
    for kind, reader in readers().items():
        sensors = [s for s in rig.sensors.values() if s.sensor_type == kind]
        streams += reader.read(recording, sensors, reading) if sensors else []
    notes = sum((sentences for _, sentences in streams), recording.notes() + jumps.notes)
    return Measurements.of_streams(*(stream for stream, _ in streams), notes=notes)


def without_jumps(rig: Rig, measurements: Measurements) -> Measurements:
    """Measurements in memory without clock jumps, as `read_measurements` removes them from files."""
    m, jumps = measurements, ClockJumps(LONGEST_S)
    if rig.cameras_alone:  # stamps only match images of different cameras
        return m
    streams = {key: jumps.cut(s, s.name) for key, s in m.streams.items()}
    return replace(m, streams=streams, notes=m.notes + jumps.notes) if jumps.notes else m


def _uncut(stream: S, what: str) -> S:
    return stream
