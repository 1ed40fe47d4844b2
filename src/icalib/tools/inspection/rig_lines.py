"""Formats values for the lines of a drafted rig file."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import PurePosixPath

from icalib.data.tables.files import table_files

_PLAIN = re.compile(r"[A-Za-z0-9_./][A-Za-z0-9_./-]*")


def place_line(name: str, kind: str, frame: str = "") -> str:
    """The line `topic: NAME` for a topic of a bag or a folder of images, `path: NAME` for a table. kind, frame: type
    and frame id, for a comment."""
    endings = (".csv", *(PurePosixPath(table.name).suffix for table in table_files()))
    field = "path" if name.removesuffix(".gz").endswith(endings) else "topic"
    return f"{field}: {name_text(name)}  # {comment(kind)}" + in_frame(frame)


def in_frame(frame: str) -> str:
    """End of a comment with the frame id; "" without one."""
    return f", frame {json.dumps(frame)}" if frame else ""


def name_text(name: str) -> str:
    """The name of a topic or file, in quotes if YAML needs them."""
    return name if _PLAIN.fullmatch(name) else json.dumps(name)


def numbers(values: Iterable[float]) -> str:
    return f"[{', '.join(map(number, values))}]"


def number(value: float) -> str:
    return repr(float(value))


def comment(text: str) -> str:
    """`text` on one line, for a comment."""
    return " ".join(text.split())
