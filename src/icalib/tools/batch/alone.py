"""One command at a time in one folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from icalib.base.extras import load_filelock
from icalib.errors import CalibrationError

LOCK = ".lock"


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Nobody else works in `folder` meanwhile, who does this, too. However this process ends, the lock ends with it.

    Raises CalibrationError where somebody else does, or the folder cannot be written.
    """
    filelock = load_filelock()
    lock = filelock.FileLock(folder / LOCK)
    try:
        with suppress(NotImplementedError):  # of a file system that has no locks
            lock.acquire(blocking=False)
    except filelock.Timeout:
        raise CalibrationError(
            f"another icalib uses {folder}; wait until it ends, stop it, or choose another folder."
        ) from None
    except OSError as error:
        raise CalibrationError(
            f"{folder} cannot be written ({error.strerror or error}); choose another folder."
        ) from error
    try:
        yield
    finally:
        lock.release()
