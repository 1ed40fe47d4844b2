"""What a result was made from: input files by hash, program versions."""

from __future__ import annotations

import hashlib
import platform
from importlib.metadata import version
from pathlib import Path

_LIBRARIES = ("numpy", "numba")


def provenance(files: list[Path]) -> dict[str, str]:
    """File name -> sha256 of its bytes."""
    return {str(f): _sha256(f) for f in files}


def _sha256(path: Path) -> str:
    with path.open("rb") as file:  # a bag may be larger than memory
        return hashlib.file_digest(file, "sha256").hexdigest()


def versions() -> dict[str, str]:
    """Versions of icalib, Python and the libraries that the numbers depend on."""
    from icalib import __version__

    return {"icalib": __version__, "python": platform.python_version()} | {n: version(n) for n in _LIBRARIES}
