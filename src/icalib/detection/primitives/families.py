"""Families of tags: the bit patterns of all ids, packed so that a pattern is looked up in microseconds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import comb

import numpy as np

from icalib.detection.primitives.decoding import least_distance
from icalib.geometry.targets.families import family_name, is_apriltag, opencv_bits

_FALSE_ALARMS = 1e-3  # most of all random patterns that may be taken for a tag


@dataclass(frozen=True)
class Family:
    """One family: `bits` x `bits` data cells; `codes` (n, 4) uint64, the pattern of id i turned by 0 to 3 quarters.

    Patterns are OpenCV's, packed row by row from the top left cell, the first cell the highest bit, white 1.
    `max_errors` is the number of wrong cells with which a pattern is still taken for one of the family.
    """

    name: str
    bits: int
    codes: np.ndarray
    max_errors: int

    @property
    def is_apriltag(self) -> bool:
        return is_apriltag(self.name)


@lru_cache(maxsize=32)
def tag_family(name: str) -> Family:
    """The family of this name (see `family_name`, which raises RigError where there is none)."""
    name = family_name(name)
    patterns = opencv_bits(name)
    n, bits, _ = patterns.shape
    codes = np.array([[_packed(np.rot90(pattern, turn)) for turn in range(4)] for pattern in patterns])
    correctable = (int(least_distance(codes)) - 1) // 2
    return Family(name, bits, codes, min(correctable, _errors_allowed(4 * n, bits * bits)))


def _errors_allowed(n_codes: int, n_cells: int) -> int:
    """Most wrong cells with which at most `_FALSE_ALARMS` of all random patterns are taken for one of the codes."""
    errors, accepted = 0, n_codes
    while (accepted := accepted + n_codes * comb(n_cells, errors + 1)) <= _FALSE_ALARMS * 2.0**n_cells:
        errors += 1
    return errors


def _packed(pattern: np.ndarray) -> np.uint64:
    value = 0
    for cell in pattern.ravel():
        value = 2 * value + int(cell)
    return np.uint64(value)
