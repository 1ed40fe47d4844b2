"""How values stand in the lines of a drafted rig file."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import PurePosixPath

from icalib.data.tables.files import table_files

_PLAIN = re.compile(r"[A-Za-z0-9_./][A-Za-z0-9_./-]*")


def place_line(name: str, kind: str, frame: str = "") -> str:
    """`topic` of a bag or a folder of images; `path` of a table. kind: of what is there, for a comment."""
    endings = (".csv", *(PurePosixPath(table.name).suffix for table in table_files()))
    field = "path" if name.removesuffix(".gz").endswith(endings) else "topic"
    return f"{field}: {name_text(name)}  # {comment(kind)}" + in_frame(frame)


def in_frame(frame: str) -> str:
    """The end of a comment."""
    return f", frame {json.dumps(frame)}" if frame else ""


def name_text(name: str) -> str:
    """A name of a topic or file, in quotes where YAML needs them."""
    return name if _PLAIN.fullmatch(name) else json.dumps(name)


def numbers(values: Iterable[float]) -> str:
    return f"[{', '.join(map(number, values))}]"


def number(value: float) -> str:
    return repr(float(value))


def comment(text: str) -> str:
    """`text` on one line."""
    return " ".join(text.split())
