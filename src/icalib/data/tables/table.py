"""Reader of numeric text tables (CSV, also gzip): exact integers and stamps, fast floats.

Table files of folder recordings, as each kind of sensor declares them in its `read` module.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from math import isfinite
from pathlib import Path

import numpy as np

from icalib.base.input_files import HEAD_BYTES, TooLargeError, gunzipped, hash_of, not_data, regular
from icalib.data.images.image_checks import Note, ignore
from icalib.data.stamps.clocks import POWERS_OF_NS, UNIT_WORDS, TimeUnit, is_rate, unit_of_stamps
from icalib.data.tables.columns import TableKind, contradicts, places_by_name, places_given, split_kind
from icalib.data.tables.table_kernels import LEFT_OUT, POWERS, parse
from icalib.errors import RecordingError
from icalib.rig import PLAIN_TABLE, TableLayout
from icalib.sensors import SENSOR_KINDS, facet

_GZIP_MAGIC = b"\x1f\x8b"
_SEPARATORS = (",", ";", "\t", None)  # None: whitespace
_MOST_UNREADABLE = 0.1  # largest share of unreadable lines; with more, the file has another format
_MOST_FALLING = 0.2  # largest share of steps back in a column of stamps; readings that do not move fall in half
_NS = 1_000_000_000
_MOST_SECONDS = 2**62 // _NS
_INTEGER_NS = -1  # in place of a power of ten: stamps must be whole nanoseconds


@dataclass(frozen=True)
class Table:
    """Rows of a table: integers (N, I) int64, decimals (N, D) float64. notes: sentences on rejected lines.

    numbers (N,) int64: index of each row in the file. written: number of rows in the file. Both include rejected rows,
    but not header, comments and blank lines.
    """

    path: Path
    integers: np.ndarray
    decimals: np.ndarray
    numbers: np.ndarray
    written: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Text:
    """Text of a table. rows: bytes from line `line` (from 1) on, with commas as separators. header: column names, empty
    if unknown. columns: number of columns."""

    path: Path
    rows: bytes
    line: int
    header: tuple[str, ...]
    columns: int


def read_table(path: Path, kind: TableKind, layout: TableLayout = PLAIN_TABLE, note: Note = ignore) -> Table:
    """Read the table at `path` with the columns of `kind`; stamps are converted to ns.

    Columns are identified by `layout`, the header, or their order. Separators are commas, semicolons, tabs or blanks.
    The unit of stamps is that of `layout`, or detected from their rate. A stamp in two columns, seconds and
    nanoseconds, is joined if header or `layout` name both. Blank lines, comments (#) and the header are skipped; a few
    unreadable lines are rejected. note: called with a sentence on rejected lines and on a detected unit. Integers are
    exact; decimals are within 2 ulp of the text. Raises RecordingError naming file, line and column.
    """
    text = _text_of(path)
    table, unit = _joined(text, kind, layout), None
    if table is None:
        table, unit = _in_ns(text, kind, _places(text, kind, layout), layout.time_unit)
    if unit:
        note(
            f"{path}: the stamps are read as {UNIT_WORDS[unit]}, as their rate shows; `time_unit` in the rig file may "
            "say otherwise."
        )
    falls = np.diff(table.integers[:, 0]) < 0
    if not (text.header or layout.columns) and falls.sum() > _MOST_FALLING * len(falls):
        raise RecordingError(f"{path}: its first column often falls, so it is no stamp; {_advice(kind)}.")
    for sentence in table.notes:
        note(sentence)
    return table


def _joined(text: _Text, kind: TableKind, layout: TableLayout) -> Table | None:
    """The table, if its stamps are in two columns, seconds and nanoseconds; else None."""
    split = split_kind(kind, layout.columns or text.header)
    if split is None or (layout.columns and len(layout.columns) == len(kind.names)):
        return None
    place = _places(text, split, layout) if layout.columns else places_by_name(split, text.header)
    if place is None:
        return None
    table = _table(text, split, place, 0)
    seconds, rest = table.integers[:, 0], table.integers[:, 1]
    good = (seconds > -_MOST_SECONDS) & (seconds < _MOST_SECONDS) & (rest >= 0) & (rest < _NS)
    notes = table.notes
    if not good.all():
        names = [name for name, to in zip(text.header, place.tolist(), strict=False) if to in (0, 1)]
        first = int(np.argmin(good))
        sentence = (
            f"{text.path}: {int((~good).sum())} of {len(good)} rows have no stamp, the first with {seconds[first]} and "
            f"{rest[first]} in {' and '.join(names)}: nanoseconds are from 0 to {_NS - 1}"
        )
        if good.mean() < 1.0 - _MOST_UNREADABLE:
            raise RecordingError(f"{sentence}; correct the program that writes them.")
        notes += (f"{sentence}; they were ignored.",)
    stamps_ns = seconds[good] * _NS + rest[good]
    integers = np.column_stack([stamps_ns, table.integers[good, 2:]])
    return Table(text.path, integers, table.decimals[good], table.numbers[good], table.written, notes)


def _in_ns(text: _Text, kind: TableKind, place: np.ndarray, given: TimeUnit | None) -> tuple[Table, TimeUnit | None]:
    """The table with stamps in ns, and the unit of the stamps in the file if it was detected from their rate, else
    None."""
    if given:
        return _table(text, kind, place, POWERS_OF_NS[given]), None
    try:
        table = _table(text, kind, place, _INTEGER_NS if kind.unit == "ns" else POWERS_OF_NS[kind.unit])
        if kind.rate_hz is None or is_rate(_instants(kind, table.integers[:, 0]), *kind.rate_hz):
            return table, None
        unit = _unit(text, kind, place)
        return (table, None) if unit is None else (_table(text, kind, place, POWERS_OF_NS[unit]), unit)
    except RecordingError:
        if (unit := _unit(text, kind, place)) is None:
            raise
    return _table(text, kind, place, POWERS_OF_NS[unit]), unit


def holds(path: Path, kind: TableKind) -> bool:
    """True if header or number of columns of the table match `kind`. Raises RecordingError as `read_table`."""
    text = _text_of(path)
    return _names_all(kind, text.header) or text.columns == len(kind.names)


def named(path: Path, kind: TableKind) -> bool:
    """True if the header of the table names the columns of `kind`; False also for a file that is no table."""
    try:
        return _names_all(kind, _text_of(path).header)
    except RecordingError:
        return False


def _names_all(kind: TableKind, header: Sequence[str]) -> bool:
    return places_by_name(split_kind(kind, header) or kind, header) is not None


def _text_of(path: Path) -> _Text:
    content = read_bytes(path)
    begin, line, before = _skip_header(content)
    rows = content[begin:] if begin else content
    first = rows[: rows.find(b"\n") if b"\n" in rows else None].strip()
    if b";" in first:
        rows = rows.translate(bytes.maketrans(b",;", b".,"))  # such files often have decimal commas
    elif b"," not in first and b"\t" in first:
        rows = rows.replace(b"\t", b",")
    elif b"," not in first:
        rows = re.sub(rb"(?<=\S) +(?=\S)", b",", rows)
    columns = rows[: rows.find(b"\n") if b"\n" in rows else None].count(b",") + 1 if first else 0
    return _Text(path, rows, line, _names(before, columns), columns)


def read_bytes(path: Path) -> bytes:
    """Content of a text file, unpacked if gzipped, without a byte order mark. Raises RecordingError if it is empty, or
    cannot be read or unpacked."""
    try:
        content = regular(path).read_bytes()
        hash_of(path).saw(0, content)
        if path.suffix == ".gz" or content.startswith(_GZIP_MAGIC):
            content = gunzipped(content)
    except TooLargeError as error:
        raise RecordingError(f"{path} is not used: {error}; unpack it with gunzip and check its content.") from error
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise RecordingError(f"{path} is a damaged or truncated gzip file ({error}); copy it again.") from error
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be read ({error.strerror or error}); check the file and its permissions."
        ) from error
    if sentence := not_data(path, content[:HEAD_BYTES]):
        raise RecordingError(sentence)
    if not content.strip():
        raise RecordingError(f"{path} is empty; record or export it again.")
    return content.removeprefix(b"\xef\xbb\xbf")


def _skip_header(content: bytes) -> tuple[int, int, list[str]]:
    """Offset [bytes] and line (from 1) of the first row, and the lines before it: comments, and at most one line of
    column names without #."""
    begin, line, before, named = 0, 1, [], False
    while begin < len(content):
        end = content.find(b"\n", begin)
        end = len(content) if end < 0 else end + 1
        text = content[begin:end].strip()
        if text and not text.startswith(b"#"):
            is_header = text[:1].isalpha() or text[:1] in b"\"'%"
            if named or not is_header or _is_number(re.split(rb"[,;\s]", text, maxsplit=1)[0]):
                break
            named = True
        before.append(text.decode("utf-8", "replace").lstrip("#% "))
        begin, line = end, line + 1
    return begin, line, before


def _names(before: Sequence[str], columns: int) -> tuple[str, ...]:
    """Column names from the last of the lines `before` that splits into `columns` texts without numbers; else empty."""
    for text in reversed(before):
        for separator in _SEPARATORS:
            names = tuple(name.strip().strip("\"'") for name in text.split(separator))
            if len(names) == columns and not any(_is_number(name.encode()) for name in names):
                return names
    return ()


def _is_number(text: bytes) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _places(text: _Text, kind: TableKind, layout: TableLayout) -> np.ndarray:
    """(n,) `place` of each column for `parse`. Raises RecordingError if the columns cannot be identified."""
    wanted = len(kind.names)
    if layout.columns:
        place = places_given(kind, text.header, layout.columns, text.columns)
        if isinstance(place, str):
            raise RecordingError(f"{text.path}: `columns` in the rig file {place}; correct it.")
        return place
    place = places_by_name(kind, text.header)
    if place is not None:
        return place
    advice = _advice(kind)
    if text.columns > wanted and text.header and not kind.more:
        raise RecordingError(f"{text.path}: its columns are {', '.join(text.header)}; {advice}.")
    if contradicts(kind, text.header):
        raise RecordingError(f"{text.path}: its header names {', '.join(text.header)}, in another order; {advice}.")
    place = np.full(max(wanted, text.columns) if kind.more else wanted, LEFT_OUT, np.int64)
    place[:wanted] = np.arange(wanted)
    return place


def _advice(kind: TableKind) -> str:
    return f"say which are {', '.join(kind.names)} by `columns: [...]` of the sensor in the rig file"


def _table(text: _Text, kind: TableKind, place: np.ndarray, power: int) -> Table:
    """The table, with stamps multiplied by 10^power. Raises RecordingError without rows, or if many are unreadable."""
    capacity = text.rows.count(b"\n") + 1
    integers = np.empty((capacity, len(kind.integers)), dtype=np.int64)
    decimals, numbers = np.empty((capacity, len(kind.decimals))), np.empty(capacity, dtype=np.int64)
    buffer = np.frombuffer(text.rows, dtype=np.uint8)
    start, stamps = (0, text.line), (kind.stamps, power)
    rows, bad, line, column = parse(buffer, start, stamps, place, POWERS, integers, decimals, numbers)
    if rows == bad == 0:
        columns = ", ".join(kind.names)
        raise RecordingError(f"{text.path} holds no rows; write one line for each reading, with the columns {columns}.")
    notes = ()
    if bad:
        sentence = _describe(text, kind, line, place, column)
        if bad > _MOST_UNREADABLE * (rows + bad):
            raise RecordingError(sentence)
        left = "the line was left out" if bad == 1 else f"{bad} lines of {rows + bad} were left out, this is the first"
        notes = (f"{sentence.rpartition(';')[0]}; {left}.",)
    return Table(text.path, integers[:rows], decimals[:rows], numbers[:rows], rows + bad, notes)


def _unit(text: _Text, kind: TableKind, place: np.ndarray) -> TimeUnit | None:
    """The unit of the stamps, detected from their rate; None if ambiguous."""
    if kind.rate_hz is None:
        return None
    alone = TableKind((), kind.names[:1])
    try:
        table = _table(text, alone, np.where(place == 0, 0, LEFT_OUT), _INTEGER_NS)
    except RecordingError:
        return None
    stamps = _instants(kind, table.decimals[:, 0])
    return unit_of_stamps(stamps, *kind.rate_hz) if len(stamps) > 2 else None


def _instants(kind: TableKind, stamps: np.ndarray) -> np.ndarray:
    """The stamps. If a stamp may have several rows (such as corners of an image), repetitions are removed."""
    if len(kind.integers) == kind.stamps:
        return stamps
    return stamps[np.concatenate([[True], np.diff(stamps) != 0])]


def _describe(text: _Text, kind: TableKind, line: int, place: np.ndarray, column: int) -> str:
    """Error message for a row that the kernel could not parse: parses it again in Python."""
    row = text.rows.split(b"\n")[line - text.line].decode("utf-8", "replace").strip()
    fields = [f.strip() for f in row.split(",")]
    spot = f"{text.path}:{line}"
    if len(fields) != len(place):
        wanted = f"{len(place)} ({', '.join(text.header if len(text.header) == len(place) else kind.names)})"
        others = len(fields) > len(place) and line == text.line and not text.header
        advice = "name those to be read by `columns` in the rig file" if others else "correct or remove it"
        return f"{spot}: the line has {len(fields)} columns instead of {wanted}; {advice}."
    name, written = kind.names[place[column]], fields[column]
    excerpt = written if len(written) <= 40 else written[:40] + "..."
    try:
        number = float(written)
    except ValueError:
        return f"{spot}: {name} is {excerpt!r}, which is not a number; correct or remove the line."
    if not isfinite(number):
        return f"{spot}: {name} is {excerpt!r}, which is not a finite number; remove the line."
    if place[column] < len(kind.integers):
        hint = " (stamps in seconds are `time_unit: s` in the rig file)" if name.endswith("[ns]") else ""
        return f"{spot}: {name} is {excerpt}, but must be a whole number below 2^63{hint}; correct the line."
    return f"{spot}: {name} is {excerpt!r}, which is not written as a plain decimal number; correct the line."


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
