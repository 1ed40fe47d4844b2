"""Text files that nobody sees half of."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from icalib.errors import CalibrationError
from icalib.file_names import below
from icalib.staging import staged


def printable(text: str) -> str:
    """`text` as a file in UTF-8 can hold it. Names of files may have other bytes, which Python keeps as lone
    surrogates; they become escapes such as \\udcfc, which JSON and YAML in quotes read back as the same name."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Writes `texts` (name -> content) into `folder`, which is made where absent: each file is the old one or the new
    one whole, and none is touched before all are written. Raises CalibrationError where that is not possible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with staged(folder) as place:
            for name, text in texts.items():
                write_text(below(place, name), text)
            for name in texts:
                (place / name).replace(folder / name)
    except OSError as error:
        raise CalibrationError(
            f"{folder} cannot be written ({error.strerror or error}); choose another place."
        ) from error


def write_text(path: Path, text: str) -> None:
    """Writes the text as it is, bytes that are no UTF-8 included. Raises OSError."""
    with path.open("w", encoding="utf-8", errors="surrogateescape", newline="") as file:
        file.write(text)
