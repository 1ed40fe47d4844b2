"""Hidden folders to write in, beside what will be replaced; those that killed writers left behind are removed."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

PREFIX = ".icalib-staging-"


@contextlib.contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """A new hidden folder in `folder`, which exists; removed at the end, with all that is still in it.

    The writer holds a lock on it, which ends with the process. A folder without a lock is a leftover, and is removed.
    Raises OSError.
    """
    with _locked(folder):
        _remove_leftovers(folder)
        place = Path(tempfile.mkdtemp(prefix=PREFIX, dir=folder))
        lock = _lock(place, wait=True)
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
        _release(lock)


def _remove_leftovers(folder: Path) -> None:
    for old in folder.glob(f"{PREFIX}*"):
        if old.is_symlink() or not old.is_dir():
            continue
        with contextlib.suppress(OSError):  # of another user
            lock = _lock(old, wait=False)
            if lock is not None:
                shutil.rmtree(old, ignore_errors=True)
            _release(lock)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    lock = _lock(folder, wait=True)
    try:
        yield
    finally:
        _release(lock)


def _lock(folder: Path, wait: bool) -> int | None:
    """A descriptor that holds the lock of `folder`; None where another process does, or there are no locks here."""
    if fcntl is None:
        return None
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        os.close(handle)
        return None
    return handle


def _release(lock: int | None) -> None:
    if lock is not None:
        os.close(lock)
