"""One file at a time, whole or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from icalib.base.staging import staged
from icalib.errors import CalibrationError


def write_whole(path: Path, content: bytes) -> None:
    """Writes the file at once: whoever looks finds the old one or the new one. Raises CalibrationError."""
    with replacing(path) as part, part.open("wb") as file:
        file.write(content)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A place to write to, which takes the place of `path` at the end, and is removed where anything fails.

    Raises CalibrationError where it cannot be written.
    """
    try:
        with staged(path.parent) as place:
            part = place / path.name
            yield part
            with part.open("r+b") as file:
                os.fsync(file.fileno())
            part.replace(path)
    except OSError as error:
        raise CalibrationError(
            f"{path} cannot be written ({error.strerror or error}); choose another folder."
        ) from error
