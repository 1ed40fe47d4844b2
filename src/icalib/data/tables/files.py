"""Files of a folder that sensors are read from, as each kind of sensor declares them in its `read` module."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from icalib.data.tables.columns import TableKind
from icalib.data.tables.table import named
from icalib.rig import TableLayout
from icalib.sensors import SENSOR_KINDS, facet

StampsOfRows = Callable[[Path, TableLayout, Callable[[str], None]], tuple[dict[int, int], int]]


@dataclass(frozen=True)
class TableFile:
    """A file that the folder of a sensor may hold.

    name: of the file, or a pattern; it may be compressed besides (.gz). type, kind: as of `TopicInfo`. stamps: reads
    its (N,) int64 ns, by a layout of the rig file. holds: whether a file of this name is one; None: it is, if no other
    declaration says so of its own. beside: the columns by whose names a table beside the folders is told to be one.
    rows: where images without stamps may take those of its rows, reads stamps [ns] by the row's number, and how many
    rows there are.
    """

    name: str
    type: str
    kind: str
    stamps: Callable[[Path, TableLayout], np.ndarray]
    holds: Callable[[Path], bool] | None = None
    beside: TableKind | None = None
    rows: StampsOfRows | None = None


@cache
def table_files() -> tuple[TableFile, ...]:
    """All that kinds of sensors declare."""
    return tuple(t for kind in SENSOR_KINDS for t in facet(kind, "read").TABLES)


def rows_of(sensor_type: str) -> TableFile | None:
    """The declaration by which images without stamps take those of a table of such a sensor; None for other types."""
    return next((t for t in facet(sensor_type, "read").TABLES if t.rows is not None), None)


def named_tables(folder: Path) -> list[tuple[Path, TableFile]]:
    """The tables in `folder` itself whose headers name the columns of a declaration."""
    declared = [t for t in table_files() if t.beside is not None]
    found = {}
    for path in sorted(folder.glob("*.csv")):
        table = next((t for t in declared if t.beside is not None and named(path, t.beside)), None)
        if table is not None:
            found[path] = table
    return list(found.items())


def files_in(folder: Path) -> list[tuple[Path, TableFile]]:
    """The files of a sensor's folder that are declared, each with one declaration, in the order of these."""
    found: dict[Path, TableFile] = {}
    for table in table_files():
        for path in sorted({p for name in (table.name, f"{table.name}.gz") for p in folder.glob(name) if p.is_file()}):
            if table.holds is None:
                found.setdefault(path, table)
            elif table.holds(path):
                found[path] = table
    return list(found.items())
