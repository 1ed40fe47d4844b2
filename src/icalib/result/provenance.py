"""Provenance of a result: hashes of its input files, and versions of the software."""

from __future__ import annotations

import platform
from importlib.metadata import version
from pathlib import Path

from icalib.base.input_files import hash_of

_LIBRARIES = ("numpy", "numba")


def provenance(files: list[Path]) -> dict[str, str]:
    """SHA-256 of the content of each file, in hexadecimal, by path."""
    return {str(f): hash_of(f).hexdigest() for f in files}


def versions() -> dict[str, str]:
    """Versions of icalib, Python and the libraries that the numbers depend on."""
    from icalib import __version__

    return {"icalib": __version__, "python": platform.python_version()} | {n: version(n) for n in _LIBRARIES}
