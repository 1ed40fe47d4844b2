"""Errors of writing, with the path and advice."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from icalib.errors import CalibrationError


@contextmanager
def writing(path: Path, advice: str = "choose another folder") -> Iterator[None]:
    """Context in which `path` is written. Raises CalibrationError in place of OSError."""
    try:
        yield
    except OSError as error:
        raise CalibrationError(f"{path} cannot be written ({error.strerror or error}); {advice}.") from error
