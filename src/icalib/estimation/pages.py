"""Arrays with pages of their own, which go back to the system as soon as the array is let go of.

The allocator keeps freed memory that lies between other arrays; where tens of megabytes come and go, that adds up.
"""

from __future__ import annotations

import math
import mmap

import numpy as np

LEAST = 1 << 20  # bytes, below which the allocator does better


def zeros(shape: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
    """As np.zeros."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    return np.zeros(shape, dtype) if size < LEAST else np.ndarray(shape, dtype, buffer=mmap.mmap(-1, size))
