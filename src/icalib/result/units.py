"""Units in which people read parameters, and by how much SI values are to be multiplied."""

from __future__ import annotations

from math import pi

SHOWN_UNITS = {"rad": ("deg", 180.0 / pi), "m": ("mm", 1e3), "s": ("ms", 1e3)}
