"""Large arrays in anonymous mmaps, so that freeing them returns memory to the operating system.

glibc keeps freed heap blocks that lie between used ones. With arrays of tens of megabytes these add up.
"""

from __future__ import annotations

import ctypes
import math
import mmap
import sys

import numpy as np

MIN_MMAP_BYTES = 1 << 20  # smaller arrays are faster on the heap
# Smaller arrays are allocated often, and fresh pages would cost more than the work on them.
MMAP_THRESHOLD_BYTES = 1 << 24
# Free memory at the end of the heap that malloc keeps. With the default of 128 kB, arrays of a few megabytes get fresh
# pages at each allocation. A larger value wastes as much memory.
TRIM_THRESHOLD_BYTES = 1 << 22
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # parameters of mallopt (malloc.h)


def mmap_zeros(shape: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
    """As np.zeros; arrays of MIN_MMAP_BYTES or more are mapped anonymously, except on Windows."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < MIN_MMAP_BYTES or sys.platform == "win32":
        return np.zeros(shape, dtype)
    return np.ndarray(shape, dtype, buffer=mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS))


def trim_heap() -> None:
    """Returns free heap memory to the operating system. Takes about 1 ms; does nothing without glibc."""
    _in_glibc("malloc_trim", 0)


def set_mmap_threshold() -> None:
    """Makes malloc map all arrays of MMAP_THRESHOLD_BYTES or more, in the whole process; does nothing without glibc.

    glibc does so at first, but raises its threshold whenever such an array is freed.
    """
    _in_glibc("mallopt", _M_MMAP_THRESHOLD, MMAP_THRESHOLD_BYTES)
    _in_glibc("mallopt", _M_TRIM_THRESHOLD, TRIM_THRESHOLD_BYTES)


def _in_glibc(name: str, *arguments: int) -> None:
    """Calls a function of the C library on Linux, if there is one of this name."""
    function = getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
    if function is not None:
        function(*arguments)
