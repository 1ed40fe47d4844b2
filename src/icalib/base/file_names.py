"""Checks of names that become file names, so that a name from an input file cannot lead out of the output folder."""

from __future__ import annotations

import re
from pathlib import Path

from icalib.errors import CalibrationError

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,99}")  # valid name of a sensor or target
NAME_WORDS = "a letter, then up to 99 letters, digits, _ or -"


def below(folder: Path, name: str) -> Path:
    """`folder / name`. Raises CalibrationError if this is not a file directly in `folder`."""
    if name in ("", ".", "..") or any(c in name for c in "/\\\0"):
        raise CalibrationError(f"{name!r} cannot be the name of a file in {folder}; rename this sensor or target.")
    return folder / name
