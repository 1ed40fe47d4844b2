"""Text files that nobody sees half of."""

from __future__ import annotations

import json
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any

from icalib.base.file_names import below
from icalib.base.own_files import sealed_texts
from icalib.base.staging import staged
from icalib.errors import CalibrationError


def printable(text: str) -> str:
    """`text` as a file in UTF-8 can hold it. Names of files may have other bytes, which Python keeps as lone
    surrogates; they become escapes such as \\udcfc, which JSON and YAML in quotes read back as the same name."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def json_text(plain: Any) -> str:
    """`plain` as JSON, with null for numbers that are not finite, which JSON does not have."""
    return json.dumps(_finite(plain), indent=1, ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not isfinite(value) else value


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


def write_sealed(path: Path, text: str) -> None:
    """Writes one text with its seal (`own_files`), as `write_texts` does."""
    write_texts(path.parent, sealed_texts({path.name: text}))


def write_text(path: Path, text: str) -> None:
    """Writes the text as it is, bytes that are no UTF-8 included. Raises OSError."""
    with path.open("w", encoding="utf-8", errors="surrogateescape", newline="") as file:
        file.write(text)
