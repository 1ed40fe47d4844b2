"""Hashes of files, taken while they are read: large ones are not read a second time.

A reader shows what it reads to `hash_of(path)`; only what no reader read is read for the hash.
"""

from __future__ import annotations

import hashlib
import io
import threading
from pathlib import Path
from typing import BinaryIO

_NEAR = 1 << 20  # bytes between two blocks, such as headers and indices, that are read at once to go on
_BLOCK = 1 << 14  # bytes read at once where nobody else does: memory stays that of the reader
_MOST = 200_000  # files that are remembered, of which each takes 0.5 kB


class FileHash:
    """sha256 of a file that is being read, mostly from front to back, perhaps several times."""

    def __init__(self, path: Path) -> None:
        self._path, self._hash, self._at = path, hashlib.sha256(), 0
        self._beside: threading.Thread | None = None

    def saw(self, offset: int, content: bytes, file: BinaryIO | None = None) -> None:
        """`content` was read at `offset`. What lies shortly before is read from `file`, whose position changes."""
        if file is not None and 0 < offset - self._at <= _NEAR:
            file.seek(self._at)
            self._add(file.read(offset - self._at))
        if offset <= self._at < offset + len(content):
            self._add(memoryview(content)[self._at - offset :])

    def read_beside(self) -> None:
        """Reads the file in a thread of its own, for readers that do not tell what they read."""
        if self._beside is None:
            self._beside = threading.Thread(target=self._read_on, daemon=True)
            self._beside.start()

    def hexdigest(self) -> str:
        """Of the whole file: reads what was not seen. Raises OSError."""
        if self._beside is not None:
            self._beside.join()
        self._read_on()
        return self._hash.hexdigest()

    def _read_on(self) -> None:
        with self._path.open("rb") as file:
            file.seek(self._at)
            while block := file.read(_BLOCK):
                self._add(block)

    def _add(self, content: bytes | memoryview) -> None:
        self._hash.update(content)
        self._at += len(content)


_hashes: dict[tuple[str, int, int, int], FileHash] = {}


def hash_of(path: Path) -> FileHash:
    """The hash of the file as it is now; a file that was changed since has another. Raises OSError."""
    about = path.stat()
    key = (str(path.absolute()), about.st_ino, about.st_size, about.st_mtime_ns)
    if key not in _hashes and len(_hashes) >= _MOST:
        _hashes.clear()
    return _hashes.setdefault(key, FileHash(path))


class HashedFile(io.FileIO):
    """A file that is read, and hashed meanwhile."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._hash = hash_of(path)

    def read(self, size: int | None = -1, /) -> bytes:
        at = self.tell()
        content = super().read(-1 if size is None else size) or b""
        self._hash.saw(at, content)
        return content
