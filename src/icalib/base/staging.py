"""Hidden temporary folders in the output folder, for atomic replacement; removes those left by killed processes."""

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
    """Context manager: a new hidden folder in the existing `folder`, removed at exit with its content.

    The process locks the hidden folder; the lock ends with the process. Hidden folders without a lock are leftovers of
    killed processes and are removed. Raises OSError.
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
        with contextlib.suppress(OSError):  # a folder of another user
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
    """Descriptor of the locked `folder`; None if another process has the lock, or the system has no flock.

    wait: wait until the lock is free.
    """
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
