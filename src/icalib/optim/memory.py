"""Memory that goes back to the system when it is let go of.

The allocator keeps freed memory that lies between other arrays; where tens of megabytes come and go, that adds up.
"""

from __future__ import annotations

import ctypes
import math
import mmap
import sys

import numpy as np

MIN_MMAP_BYTES = 1 << 20  # bytes, below which the allocator does better
# bytes of what comes and goes: smaller arrays are made often, and new pages cost more than they do
MMAP_THRESHOLD_BYTES = 1 << 24
# Bytes of freed memory at the end of the heap that stay there. By default 128 kB do: arrays of a few megabytes that are
# made again and again would get new pages each time. More holds more memory than is in use.
TRIM_THRESHOLD_BYTES = 1 << 22
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of mallopt, in malloc.h


def mmap_zeros(shape: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
    """As np.zeros, with pages of its own where it is large."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < MIN_MMAP_BYTES or sys.platform == "win32":
        return np.zeros(shape, dtype)
    return np.ndarray(shape, dtype, buffer=mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS))


def trim_heap() -> None:
    """What nobody uses any more goes back to the system, where the C library knows how to (glibc). Takes about 1 ms."""
    _in_glibc("malloc_trim", 0)


def set_mmap_threshold() -> None:
    """From now on large arrays have pages of their own, in the whole process, where the C library can do that (glibc).

    It does so at first, but once such an array has been freed, the next ones as large lie between the small ones.
    """
    _in_glibc("mallopt", _M_MMAP_THRESHOLD, MMAP_THRESHOLD_BYTES)
    _in_glibc("mallopt", _M_TRIM_THRESHOLD, TRIM_THRESHOLD_BYTES)


def _in_glibc(name: str, *arguments: int) -> None:
    function = getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
    if function is not None:
        function(*arguments)
