"""Compressed data and arrays, unpacked up to a limit in proportion to their size: a few bytes can claim terabytes."""

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

FREE_BYTES, RATIO = 16 << 20, 256  # sensors' data shrink to a tenth; images of one colour, and zeros, to less
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
    """What is unpacked is out of proportion to what is stored."""

    def __init__(self) -> None:
        super().__init__(f"it unpacks to more than {LIMIT_WORDS}")


def most_bytes(stored: int) -> int:
    """How many bytes `stored` bytes may unpack to."""
    return FREE_BYTES + RATIO * stored


def unpacked(decompressor: Any, stored: bytes) -> bytes:
    """`stored` by a decompressor of bz2, lz4 or zstd. Raises TooLargeError, and what the decompressor raises."""
    most = most_bytes(len(stored))
    return _within(decompressor.decompress(stored, max_length=most + 1), most)


def gunzipped(stored: bytes) -> bytes:
    """A gzip file's content. Raises TooLargeError, and what the module gzip raises."""
    most = most_bytes(len(stored))
    with gzip.open(io.BytesIO(stored)) as file:
        return _within(file.read(most + 1), most)


def copy_unpacked(packed: BinaryIO, out: BinaryIO, stored: int) -> None:
    """Copies what `packed` unpacks from `stored` bytes. Raises TooLargeError, and what `packed` raises."""
    left = most_bytes(stored)
    while block := packed.read(1 << 16):  # small, since of a file that was cut off the last read is lost
        left -= len(block)
        if left < 0:
            raise TooLargeError
        out.write(block)


def load_arrays(source: Path | bytes, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an npz file, all or those of `names` that are there; nothing in it is executed.

    Raises OSError where the file cannot be read, ValueError with the reason where its content is something else.
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
    """Refused before any memory is asked for, where its header claims more than there is."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        shape, _, dtype = readers[version](file) if version in readers else ((-1,), False, np.dtype("O"))
        left = member.file_size - file.tell()
    if dtype.hasobject and version in readers:
        raise ValueError("Object arrays cannot be loaded: they may run programs")
    if dtype.hasobject or any(side < 0 for side in shape):
        raise ValueError(f"{member.filename} is not an array of numbers")
    if math.prod(shape) * dtype.itemsize != left:
        raise ValueError(f"{member.filename} does not have the size that its header states")
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _within(content: bytes, most: int) -> bytes:
    if len(content) > most:
        raise TooLargeError
    return content
