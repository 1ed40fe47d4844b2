"""Units of tolerances; a module without imports, so that the command line starts fast."""

from __future__ import annotations

# Tolerances of differences without a known standard deviation.
DEFAULT_TOLERANCES = {"deg": 0.1, "mm": 5.0, "ms": 1.0, "px": 1.0, "percent": 0.1}
UNITS = tuple(DEFAULT_TOLERANCES)
