"""Suggestion of a similar valid name for a misspelt one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

ALIKE = 0.6  # least similarity of two names by difflib, 0 to 1; lower values suggest less similar names


def suggestion(name: str, valid: Iterable[str]) -> str:
    """End of a message: ", did you mean 'x'", x being the most similar valid name regardless of case; empty if none."""
    by_lower = {v.lower(): v for v in valid}
    near = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=ALIKE)
    return f", did you mean {by_lower[near[0]]!r}" if near else ""
