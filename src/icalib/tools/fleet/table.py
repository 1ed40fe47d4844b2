"""All results of a fleet as one SQLite table, which is written anew from the records each time."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path

from icalib.base.files import DATABASE_ID, printable
from icalib.errors import CalibrationError
from icalib.geometry.euler import rpy
from icalib.result.quantities import TURNS
from icalib.tools.batch import replacing
from icalib.tools.fleet.result import JobResult

_COLUMNS = (
    "robot TEXT",
    "time TEXT",
    "job TEXT",
    "status TEXT",
    "sentence TEXT",
    "sensor TEXT",
    "block TEXT",
    "entry TEXT",
    "value REAL",
    "sigma REAL",
    "unit TEXT",
    "verdict TEXT",
    "usability TEXT",
)
_NOTHING = (None,) * 7


def write_table(path: Path, results: Iterable[JobResult]) -> None:
    """Writes the table `results` atomically: a row for each parameter of each job, and one for a job without a result.
    Units are SI. Rotations have rows of roll, pitch and yaw, each with its own sigma, and of x, y, z: sigma and verdict
    of small rotations about the sensor's axes.

    Raises CalibrationError if the file cannot be written.
    """
    try:
        with replacing(path) as part, closing(sqlite3.connect(part)) as base:
            base.execute(f"PRAGMA application_id = {DATABASE_ID}")
            base.execute(f"CREATE TABLE results ({', '.join(_COLUMNS)})")
            base.executemany(
                f"INSERT INTO results VALUES ({', '.join('?' * len(_COLUMNS))})",
                (r for one in results for r in rows(one)),
            )
            base.commit()
    except sqlite3.Error as error:
        raise CalibrationError(f"{path} cannot be written ({error}); choose another folder.") from error


def rows(one: JobResult) -> Iterator[tuple[object, ...]]:
    """Rows of one job, cells as in `_COLUMNS`."""
    about = (
        one.job.robot,
        one.time.isoformat() if one.time else None,
        one.job.name,
        one.status,
        printable(one.sentence),
    )
    usability = one.record.verdict or None
    if not one.record.blocks:
        yield (*about, *_NOTHING, usability)
    for b in one.record.blocks:
        values: list[float | None] = [None] * len(b.labels) if b.value.ndim == 2 else b.value.tolist()
        if b.value.ndim == 2:
            for turn, value, std in zip(TURNS, rpy(b.value).tolist(), b.rpy_std.tolist(), strict=True):
                yield (*about, b.sensor, b.name, turn, value, std, b.unit, None, usability)
        for label, value, std, verdict in zip(b.labels, values, b.std.tolist(), b.verdict, strict=True):
            yield (*about, b.sensor, b.name, label or b.name, value, std, b.unit, verdict, usability)
