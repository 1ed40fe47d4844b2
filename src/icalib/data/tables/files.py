"""Table files of folder recordings, as each kind of sensor declares them in its `read` module."""

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
    """Declaration of a table file in the folder of a sensor.

    name: file name or pattern; a compressed file with the additional suffix .gz also matches. type, kind: as of
    `TopicInfo`. stamps: function that reads its stamps, (N,) int64 ns, with a layout of the rig file. holds: function
    that tells from the content whether a file is of this type; None: it is, unless `holds` of another declaration is
    true. beside: columns that identify a table of this type outside of sensor folders by its header; None: no such
    table. rows: function that returns stamps [ns] by row number and the number of rows, if images without timestamps
    may take the stamps of rows.
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
    """Declarations of all kinds of sensors."""
    return tuple(t for kind in SENSOR_KINDS for t in facet(kind, "read").TABLES)


def rows_of(sensor_type: str) -> TableFile | None:
    """The declaration with `rows` of a sensor type, for images without timestamps; None if there is none."""
    return next((t for t in facet(sensor_type, "read").TABLES if t.rows is not None), None)


def named_tables(folder: Path) -> list[tuple[Path, TableFile]]:
    """CSV files directly in `folder` whose header names the columns `beside` of a declaration, with the declaration."""
    declared = [t for t in table_files() if t.beside is not None]
    declarations = {}
    for path in sorted(folder.glob("*.csv")):
        table = next((t for t in declared if t.beside is not None and named(path, t.beside)), None)
        if table is not None:
            declarations[path] = table
    return list(declarations.items())


def files_in(folder: Path) -> list[tuple[Path, TableFile]]:
    """Declared files in the folder of a sensor, each with its declaration, in the order of `table_files`."""
    declarations: dict[Path, TableFile] = {}
    for table in table_files():
        for path in sorted({p for name in (table.name, f"{table.name}.gz") for p in folder.glob(name) if p.is_file()}):
            if table.holds is None:
                declarations.setdefault(path, table)
            elif table.holds(path):
                declarations[path] = table
    return list(declarations.items())
