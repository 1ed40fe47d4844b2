"""Safe decompression: limits the unpacked size relative to the stored size, against decompression bombs."""

from __future__ import annotations

import gzip
import io
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from icalib.base.file_hashes import HashedFile

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
