"""Families of tags: the bit patterns of all ids, packed for a fast lookup."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import comb

import numpy as np

from icalib.detection.primitives.decoding import least_distance
from icalib.geometry.targets.families import family_name, is_apriltag, opencv_bits

_FALSE_ALARMS = 1e-3  # largest share of random patterns that may be accepted as tags


@dataclass(frozen=True)
class Family:
    """One family of tags with `bits` x `bits` data cells. codes (n, 4) uint64: the pattern of id i, rotated by 0 to 3
    quarter turns.

    Patterns are OpenCV's, packed row by row from the top left cell, the first cell in the highest bit, white as 1.
    max_errors: wrong cells with which a pattern is still accepted.
    """

    name: str
    bits: int
    codes: np.ndarray
    max_errors: int

    @property
    def is_apriltag(self) -> bool:
        """Whether this is a family of AprilTags, not of ArUco markers."""
        return is_apriltag(self.name)


@lru_cache(maxsize=32)
def tag_family(name: str) -> Family:
    """The family of this name. Raises RigError if there is none, see `family_name`."""
    name = family_name(name)
    patterns = opencv_bits(name)
    n, bits, _ = patterns.shape
    codes = np.array([[_packed(np.rot90(pattern, turn)) for turn in range(4)] for pattern in patterns])
    correctable = (int(least_distance(codes)) - 1) // 2
    return Family(name, bits, codes, min(correctable, _errors_allowed(4 * n, bits * bits)))


def _errors_allowed(n_codes: int, n_cells: int) -> int:
    """Largest number of wrong cells at which at most `_FALSE_ALARMS` of all random patterns are accepted."""
    errors, accepted = 0, n_codes
    while (accepted := accepted + n_codes * comb(n_cells, errors + 1)) <= _FALSE_ALARMS * 2.0**n_cells:
        errors += 1
    return errors


def _packed(pattern: np.ndarray) -> np.uint64:
    """The cells of a pattern as uint64, the first cell in the highest bit."""
    value = 0
    for cell in pattern.ravel():
        value = 2 * value + int(cell)
    return np.uint64(value)
