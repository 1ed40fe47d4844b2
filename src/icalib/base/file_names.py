"""Names that become names of files: whatever file a name comes from, it stays in the folder it is put into."""

from __future__ import annotations

import re
from pathlib import Path

from icalib.errors import CalibrationError

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,99}")  # of sensors and targets
NAME_WORDS = "a letter, then up to 99 letters, digits, _ or -"


def below(folder: Path, name: str) -> Path:
    """`folder / name`. Raises CalibrationError where that is not right in `folder`."""
    if name in ("", ".", "..") or any(c in name for c in "/\\\0"):
        raise CalibrationError(f"{name!r} cannot be the name of a file in {folder}; rename this sensor or target.")
    return folder / name
