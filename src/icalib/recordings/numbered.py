"""Pictures without stamps beside a table of poses, as hand-eye calibration takes them: picture k belongs to row k."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from icalib.errors import RecordingError
from icalib.recordings.clocks import is_rate
from icalib.recordings.columns import STAMP, TableKind
from icalib.recordings.euroc_images import pictures_in, stamped_by_name
from icalib.recordings.image_checks import Note
from icalib.recordings.poses import RATE_HZ, is_tum_text
from icalib.recordings.table import read_table

_RATE_HZ = (1e-3, 1000.0)  # of images: numbers that mean another one are no stamps
_STAMPS = TableKind(("t [ns]",), known=(STAMP,), rate_hz=RATE_HZ, more=True)  # of rows whose poses are none, too


def numbered_pictures(folder: Path) -> list[tuple[int, Path]]:
    """Number and file of each picture of `folder`, or of `data` in it, in order; empty where they have stamps, or some
    has no number."""
    data = pictures_in(folder / "data")
    files = data or pictures_in(folder)
    if not files or (data and (folder / "data.csv").is_file()) or stamped_by_name(files) is not None:
        return []
    groups = [re.findall(r"\d+", path.stem) for path in files]
    if not all(groups):
        return []
    found = sorted((int(own[-1]), path) for own, path in zip(groups, files, strict=True))
    numbers = np.array([number for number, _ in found], dtype=object)
    stamps = data and all(path.stem.isdecimal() for path in files) and numbers[-1] < 2**63
    return [] if stamps and is_rate(numbers.astype(np.int64), *_RATE_HZ) else found


def stamped_by_rows(found: list[tuple[int, Path]], table: Path, note: Note) -> list[tuple[int, Path]]:
    """Stamps [ns] and files of numbered pictures: those of the rows of poses in `table`, in order where there are as
    many, else by number, from 0 on where one has 0, and from 1 on otherwise. `note` is told. Raises RecordingError
    where two have one number, or there is no row for one."""
    folder, numbers = found[0][1].parent, [number for number, _ in found]
    again = next((k for k in range(1, len(numbers)) if numbers[k] == numbers[k - 1]), None)
    if again is not None:
        raise RecordingError(
            f"{found[again - 1][1]} and {found[again][1].name} have the same number, {numbers[again]}; give each "
            "picture its own, that of the row of its pose."
        )
    kind = replace(_STAMPS, unit="s") if is_tum_text(table) else _STAMPS
    stamps_ns = read_table(table, kind).integers[:, 0]
    in_order = len(numbers) == len(stamps_ns)
    rows = list(range(len(numbers))) if in_order else [n - min(1, numbers[0]) for n in numbers]
    if rows[-1] >= len(stamps_ns):
        raise RecordingError(
            f"{folder} holds {len(found)} pictures without stamps, up to number {numbers[-1]}, and {table} "
            f"{len(stamps_ns)} rows; number each picture as the row of its pose, or give pictures stamps as names."
        )
    how = "in order" if in_order else f"by number, {numbers[0] and 1} being that of the first row"
    note(
        f"{folder}: {len(found)} pictures have no stamps; each has that of its row of {table}, {how}: picture "
        f"{found[0][1].name} belongs to row {rows[0] + 1}."
    )
    return [(int(stamps_ns[row]), path) for row, (_, path) in zip(rows, found, strict=True)]
