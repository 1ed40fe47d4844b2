"""Identity of the running code."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path


@cache
def program() -> str:
    """Digest of the Python source of `icalib`, 16 hexadecimal digits. Results of different versions, released or
    not, must not be mixed."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[2]
    for file in sorted(root.rglob("*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]
