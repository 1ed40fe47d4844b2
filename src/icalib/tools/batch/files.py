"""Atomic writing of single files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from icalib.base.staging import staged
from icalib.base.writing import writing


def write_atomically(path: Path, content: bytes) -> None:
    """Writes the file atomically: readers see the old content or the new one. Raises CalibrationError if it fails."""
    with replacing(path) as part, part.open("wb") as file:
        file.write(content)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Context with the path of a temporary file, which replaces `path` at the end, or is removed if anything fails.

    Raises CalibrationError if the file cannot be written.
    """
    with writing(path), staged(path.parent) as place:
        part = place / path.name
        yield part
        with part.open("r+b") as file:
            os.fsync(file.fileno())
        part.replace(path)
