"""Units of tolerances, apart from what uses them, so that the command line knows them at once."""

from __future__ import annotations

# Where no standard deviation is known, differences up to these do not count.
DEFAULT_TOLERANCES = {"deg": 0.1, "mm": 5.0, "ms": 1.0, "px": 1.0, "percent": 0.1}
UNITS = tuple(DEFAULT_TOLERANCES)
