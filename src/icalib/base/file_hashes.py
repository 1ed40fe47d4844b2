"""sha256 of input files, computed while they are read, so that large files are not read twice.

A reader passes each block to `hash_of(path).saw`. `hexdigest` reads only the bytes after those that were passed.
"""

from __future__ import annotations

import hashlib
import io
import threading
from pathlib import Path
from typing import BinaryIO

_NEAR = 1 << 20  # bytes: a gap up to this (headers, an index) between two blocks is read at once, to continue the hash
_BLOCK = 1 << 14  # bytes per read of `FileHash` itself; small, so that it needs no noticeable memory
_MOST = 200_000  # remembered hashes; each takes 0.5 kB


class FileHash:
    """sha256 of a file that a reader reads at the same time, mostly from front to back, perhaps several times."""

    def __init__(self, path: Path) -> None:
        self._path, self._hash, self._at = path, hashlib.sha256(), 0
        self._beside: threading.Thread | None = None

    def saw(self, offset: int, content: bytes, file: BinaryIO | None = None) -> None:
        """Add `content`, which was read at byte `offset`. Bytes hashed before are skipped.

        A gap of up to 1 MiB before `offset` is read from `file`, whose position changes. After a larger gap, or without
        `file`, `content` is ignored, and `hexdigest` reads it again.
        """
        if file is not None and 0 < offset - self._at <= _NEAR:
            file.seek(self._at)
            self._add(file.read(offset - self._at))
        if offset <= self._at < offset + len(content):
            self._add(memoryview(content)[self._at - offset :])

    def read_beside(self) -> None:
        """Hash the file in a background thread, for readers that do not call `saw`."""
        if self._beside is None:
            self._beside = threading.Thread(target=self._read_on, daemon=True)
            self._beside.start()

    def hexdigest(self) -> str:
        """Hash of the whole file, in hexadecimal; reads the bytes that are not hashed yet. Raises OSError."""
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
    """The hash of the file in its current state, shared by all readers. A changed file (other inode, size or
    modification time) has a new one. Raises OSError."""
    about = path.stat()
    key = (str(path.absolute()), about.st_ino, about.st_size, about.st_mtime_ns)
    if key not in _hashes and len(_hashes) >= _MOST:
        _hashes.clear()
    return _hashes.setdefault(key, FileHash(path))


class HashedFile(io.FileIO):
    """A file opened for reading whose `read` also updates its hash (`hash_of`)."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._hash = hash_of(path)

    def read(self, size: int | None = -1, /) -> bytes:
        at = self.tell()
        content = super().read(-1 if size is None else size) or b""
        self._hash.saw(at, content)
        return content
