"""The nearest valid name to one that does not exist."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

ALIKE = 0.6  # similarity by difflib, from 0 to 1: below it, names have little in common


def suggestion(name: str, valid: Iterable[str]) -> str:
    """The words that point to the valid name nearest to `name`, whatever the case of either; empty if none is near."""
    by_lower = {v.lower(): v for v in valid}
    near = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=ALIKE)
    return f", did you mean {by_lower[near[0]]!r}" if near else ""
