"""Text files that nobody sees half of."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from icalib.errors import CalibrationError


def printable(text: str) -> str:
    """`text` as a file in UTF-8 can hold it. Names of files may have other bytes, which Python keeps as lone
    surrogates; they become escapes such as \\udcfc, which JSON and YAML in quotes read back as the same name."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Writes `texts` (name -> content) into `folder`, which is made where absent: each file is the old one or the new
    one whole, and none is touched before all are written. Raises CalibrationError where that is not possible."""
    parts: dict[str, Path] = {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            parts[name] = write_part(folder, text)
        for name, part in parts.items():
            part.replace(folder / name)
    except OSError as error:
        raise CalibrationError(
            f"{folder} cannot be written ({error.strerror or error}); choose another place."
        ) from error
    finally:
        for part in parts.values():
            with contextlib.suppress(OSError):
                part.unlink()


def write_part(folder: Path, text: str) -> Path:
    """A new file in `folder` with the text and a name of its own, to be given its name once all is well; none is left
    where it cannot be written. Raises OSError."""
    handle, name = tempfile.mkstemp(suffix=".part", dir=folder)
    part = Path(name)
    try:
        with open(handle, "w", encoding="utf-8", errors="surrogateescape", newline="") as file:
            file.write(text)
        part.chmod(0o666 & ~_umask())
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise
    return part


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
