"""What a result was made from: input files by hash, program versions."""

from __future__ import annotations

import hashlib
import platform
from importlib.metadata import version
from pathlib import Path

_LIBRARIES = ("numpy", "numba")


def provenance(files: list[Path]) -> dict[str, str]:
    """File name -> sha256 of its bytes."""
    return {str(f): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


def versions() -> dict[str, str]:
    """Versions of icalib, Python and the libraries that the numbers depend on."""
    from icalib import __version__

    return {"icalib": __version__, "python": platform.python_version()} | {n: version(n) for n in _LIBRARIES}
