"""Text and JSON files, written atomically: a reader never sees an incomplete file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any

from icalib.base.file_names import below
from icalib.base.own_files import sealed_texts
from icalib.base.staging import staged
from icalib.base.writing import writing


def printable(text: str) -> str:
    """`text` that UTF-8 can encode: lone surrogates become escapes such as \\udcfc.

    Python represents bytes of a file name that are not UTF-8 as lone surrogates. JSON and quoted YAML read the escapes
    back as the same name.
    """
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def json_text(plain: Any) -> str:
    """`plain` (dicts, lists, numbers, text) as JSON. NaN and infinity become null, as JSON lacks them."""
    return json.dumps(_finite(plain), indent=1, ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Writes `texts` (name -> content) into `folder`, created if needed. Each file is replaced atomically, after all
    new files were written to a temporary folder. Raises CalibrationError if the folder cannot be written."""
    with writing(folder, "choose another place"):
        folder.mkdir(parents=True, exist_ok=True)
        with staged(folder) as place:
            for name, text in texts.items():
                write_text(below(place, name), text)
            for name in texts:
                (place / name).replace(folder / name)


def write_sealed(path: Path, text: str) -> None:
    """Writes `text` with a seal (see `own_files`) to `path`, atomically. Raises CalibrationError as `write_texts`."""
    write_texts(path.parent, sealed_texts({path.name: text}))


def write_text(path: Path, text: str) -> None:
    """Writes `text` in UTF-8, with unchanged line ends and without atomicity. Bytes that are not UTF-8 are preserved
    (surrogateescape). Raises OSError."""
    with path.open("w", encoding="utf-8", errors="surrogateescape", newline="") as file:
        file.write(text)
