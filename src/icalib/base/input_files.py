"""Input files: their sha256, safe decompression, and files without readable data.

The sha256 is computed while a file is read, so that large files are not read twice. A reader passes each block to
`hash_of(path).saw`. `hexdigest` reads only the bytes after those that were passed.

Decompression limits the unpacked size relative to the stored size, against decompression bombs. Files without readable
data are pointers of Git LFS and git-annex, and videos in place of bags.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import math
import stat
import struct
import threading
import tokenize
import zipfile
import zlib
from collections.abc import Collection
from errno import EINVAL
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

_NEAR = 1 << 20  # bytes: a gap up to this (headers, an index) between two blocks is read at once, to continue the hash
_BLOCK = 1 << 14  # bytes per read of `FileHash` itself; small, so that it needs no noticeable memory
_MOST = 200_000  # remembered hashes; each takes 0.5 kB


def regular(path: Path) -> Path:
    """`path`. Raises OSError if it does not exist, or is a pipe or a device, which may have no end."""
    if not (stat.S_ISREG(mode := path.stat().st_mode) or stat.S_ISDIR(mode)):
        raise OSError(EINVAL, "a pipe or a device, not a file", str(path))
    return path


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


FREE_BYTES, RATIO = 16 << 20, 256  # sensor data shrink to a tenth; uniform images and zeros shrink more
LIMIT_WORDS = f"{FREE_BYTES >> 20} MiB and {RATIO} times its size"
_NOT_ARRAYS = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    TypeError,
    SyntaxError,
    RuntimeError,
    OverflowError,
    MemoryError,
    struct.error,
    tokenize.TokenError,
    zlib.error,
    zipfile.BadZipFile,
)


class TooLargeError(ValueError):
    """The unpacked data exceed the limit for their stored size (`most_bytes`)."""

    def __init__(self) -> None:
        super().__init__(f"it unpacks to more than {LIMIT_WORDS}")


def most_bytes(stored: int) -> int:
    """Largest permitted size [bytes] after unpacking `stored` bytes."""
    return FREE_BYTES + RATIO * stored


def unpacked(decompressor: Any, stored: bytes) -> bytes:
    """`stored`, unpacked by a decompressor of bz2, lz4 or zstd. Raises TooLargeError, and the decompressor's errors."""
    most = most_bytes(len(stored))
    return _within(decompressor.decompress(stored, max_length=most + 1), most)


def gunzipped(stored: bytes) -> bytes:
    """`stored`, a gzip file, unpacked. Raises TooLargeError, and errors of the module gzip."""
    most = most_bytes(len(stored))
    with gzip.open(io.BytesIO(stored)) as file:
        return _within(file.read(most + 1), most)


def copy_unpacked(packed: BinaryIO, out: BinaryIO, stored: int) -> None:
    """Copies the unpacked content of `packed`, a file that decompresses `stored` bytes, to `out`.

    Raises TooLargeError, and errors of `packed`.
    """
    remaining = most_bytes(stored)
    while block := packed.read(1 << 16):  # small: the last block of a truncated file is lost
        remaining -= len(block)
        if remaining < 0:
            raise TooLargeError
        out.write(block)


def load_arrays(source: Path | bytes, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Arrays of an npz file by name, without pickle: all, or those of `names` that exist. source: path or content.

    Raises OSError if the file is not found, ValueError with the reason for any other failure.
    """
    in_memory = isinstance(source, bytes)
    stored = len(source) if in_memory else source.stat().st_size
    try:
        file = io.BytesIO(source) if in_memory else HashedFile(source)
        with file, zipfile.ZipFile(file) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            wanted = [name for name in members if names is None or name in names]
            if sum(members[name].file_size for name in wanted) > most_bytes(stored):
                raise TooLargeError
            return {name: _array(archive, members[name]) for name in wanted}
    except _NOT_ARRAYS as error:
        raise ValueError(next(iter(str(error).splitlines()), "") or type(error).__name__) from error


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """One array of an npz file. Raises ValueError for Python objects, and before memory is allocated if the size in the
    header differs from the stored one."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        shape, _, dtype = readers[version](file) if version in readers else ((-1,), False, np.dtype("O"))
        n_bytes = member.file_size - file.tell()
    if dtype.hasobject and version in readers:
        raise ValueError("Object arrays cannot be loaded: they may run programs")
    if dtype.hasobject or any(side < 0 for side in shape):
        raise ValueError(f"{member.filename} is not an array of numbers")
    if math.prod(shape) * dtype.itemsize != n_bytes:
        raise ValueError(f"{member.filename} does not have the size that its header states")
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _within(content: bytes, most: int) -> bytes:
    if len(content) > most:
        raise TooLargeError
    return content


VIDEO_FILE = "video file"  # `TopicInfo.type` of a video
HEAD_BYTES = 64  # length of `head` for `not_data`
VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".h264", ".h265", ".mjpeg", ".insv", ".360")
_POINTERS = {b"version https://git-lfs.github.com/spec": "git lfs pull", b"/annex/objects/": "git annex get"}
_CONTAINERS = ((4, b"ftyp"), (0, b"\x1aE\xdf\xa3"), (8, b"AVI "))  # MP4 and MOV, Matroska and WebM, AVI


def not_data(path: Path, head: bytes) -> str | None:
    """Error message if a file that begins with `head` is a pointer of Git LFS or git-annex, or a video; else None."""
    for magic, command in _POINTERS.items():
        if head.startswith(magic):
            return f"{path} is a pointer to a file that was not downloaded; run `{command}` where it comes from."
    if any(head[at : at + len(magic)] == magic for at, magic in _CONTAINERS):
        return f"{path} is a video; give the folder that it lies in as the recording."
    return None


def is_video(path: Path) -> bool:
    """True if the suffix is that of a video file."""
    return path.suffix.lower() in VIDEO_SUFFIXES
