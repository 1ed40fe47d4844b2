"""Opens several recordings of a rig under unique names; adds names and notes to errors."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from math import inf
from pathlib import Path

from icalib.data.recordings.base import Recording
from icalib.data.recordings.opening import open_recording
from icalib.errors import CalibrationError, RecordingError

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
