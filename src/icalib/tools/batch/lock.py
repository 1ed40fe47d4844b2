"""Exclusive lock on a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from icalib.base.extras import load_filelock
from icalib.base.writing import writing
from icalib.errors import CalibrationError

LOCK = ".lock"


@contextmanager
def exclusive_lock(folder: Path) -> Iterator[None]:
    """Context with an exclusive lock on `folder`. The lock ends with the process, however that ends.

    Raises CalibrationError if another process has the lock, or the folder cannot be written. A file system without
    locks is not protected.
    """
    filelock = load_filelock()
    lock = filelock.FileLock(folder / LOCK)
    with writing(folder), suppress(NotImplementedError):  # the file system has no locks
        try:
            lock.acquire(blocking=False)
        except filelock.Timeout:
            raise CalibrationError(
                f"another icalib uses {folder}; wait until it ends, stop it, or choose another folder."
            ) from None
    try:
        yield
    finally:
        lock.release()
