"""Text tables (CSV): parsing, identification of columns, tables of each kind of sensor."""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from math import isfinite
from pathlib import Path

import numpy as np

from icalib.base.files import HEAD_BYTES, TooLargeError, gunzipped, hash_of, not_data, regular
from icalib.base.remark import Remark
from icalib.data.images import Note, are_most, ignore, pictures_in, stamped_by_name
from icalib.data.stamps import POWERS_OF_NS, UNIT_WORDS, TimeUnit, is_rate, unit_of_stamps
from icalib.data.table_kernels import LEFT_OUT, POWERS, parse
from icalib.errors import RecordingError
from icalib.kinds import readers
from icalib.rig import PLAIN_TABLE, Axes, TableLayout

# Reader of numeric text tables (CSV, also gzip): exact integers and stamps, fast floats.
#
# Table files of folder recordings, as each kind of sensor declares them in its `read` module.

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
    notes: tuple[Remark, ...] = ()


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
        sentence = (
            f"{path}: the stamps are read as {UNIT_WORDS[unit]}, as their rate shows; `time_unit` in the rig file "
            "may say otherwise."
        )
        note(Remark("stamp_unit_recognised", sentence))
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
        notes += (Remark("rows_without_stamp", f"{sentence}; they were ignored."),)
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
        notes = (Remark("table_lines_unreadable", f"{sentence.rpartition(';')[0]}; {left}."),)
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


StampsOfRows = Callable[[Path, TableLayout, Note], tuple[dict[int, int], int]]


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
    return tuple(t for reader in readers().values() for t in reader.tables)


def rows_of(sensor_type: str) -> TableFile | None:
    """The declaration with `rows` of a sensor type, for images without timestamps; None if there is none."""
    return next((t for t in readers()[sensor_type].tables if t.rows is not None), None)


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


# Identification of the columns of a table: by the names in its header, by the rig file, or by their order.
#
# Permutation and signs of vector components as the rig file states.

_UNIT = re.compile(r"\[[^]]*\]|\([^)]*\)")
_CAMEL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")
# Prefixes of column names without meaning: those of rostopic, and names of sensors.
_FROM = re.compile(r"(field|msg|data|imu|imu\d+|odom|pose\d*|transform|twist|sensor|world)_(?=[a-z])")
STAMP = (r"(header_)?stamp(_ns|_nsec)?", r"time_?stamp(_ns|_us|_ms|_s)?", r"(time|t|ts)(_ns|_us|_ms|_s)?")
# A stamp in two columns, as in ROS messages: whole seconds and remaining nanoseconds.
_OF_STAMP = r"((header_)?stamp_|time_?stamp_|time_|ros_?time_)?"
SECONDS = tuple(rf"{of}(secs?|seconds?)" for of in (r"(header_)?stamp_", _OF_STAMP))
NANOSECONDS = tuple(rf"{of}(n_?secs?|nano_?secs?|nano_?seconds?)" for of in (r"(header_)?stamp_", _OF_STAMP))


@dataclass(frozen=True)
class TableKind:
    """The columns of a kind of table.

    integers: names of integer columns, stamps first; names of stamps end in [ns]. decimals: names of the float columns
    that follow. known: for each column, regular expressions of header names, the most specific first; empty: columns
    are identified by order only. rate_hz: slowest and fastest rate of stamps, to detect a unit other than `unit`; None:
    the unit is `unit`. more: further columns, which are not read, may follow if columns are identified by order. split:
    the first two integers are the seconds and nanoseconds of one stamp.
    """

    integers: tuple[str, ...]
    decimals: tuple[str, ...] = ()
    known: tuple[tuple[str, ...], ...] = ()
    rate_hz: tuple[float, float] | None = None
    unit: TimeUnit = "ns"
    more: bool = False
    split: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        return self.integers + self.decimals

    @property
    def stamps(self) -> int:
        """Number of integer columns that are stamps, or parts of a split stamp."""
        return 2 if self.split else sum(name.endswith("[ns]") for name in self.integers)


def vector_names(quantities: str, axes: str = "xyz") -> tuple[tuple[str, ...], ...]:
    """Regular expressions of header names for each component of a vector, for `TableKind.known`. quantities: regular
    expression of names of the vector."""
    return tuple((rf"({quantities})_?{axis}", rf"{axis}_?({quantities})") for axis in axes)


def places_by_name(kind: TableKind, header: Sequence[str]) -> np.ndarray | None:
    """(n,) for each column of the header, the index in `kind.names`, or LEFT_OUT if it is not used.

    None if the names are not sufficient. If exactly one column is missing and exactly one column has an unknown name,
    they are matched.
    """
    if not kind.known or len(header) < len(kind.names):
        return None
    words = [_plain(name) for name in header]
    places = [_column(words, known) for known in kind.known]
    missing = [k for k, at in enumerate(places) if at is None]
    left = [at for at in range(len(words)) if at not in places]
    if len(missing) == 1 and len(left) == 1:
        places[missing[0]], missing = left[0], []
    if missing or len(set(places)) < len(places):
        return None
    return _place_of_each(len(header), [at for at in places if at is not None])


def split_kind(kind: TableKind, header: Sequence[str]) -> TableKind | None:
    """`kind` with its stamp in two columns (`split`), if the header names both; else None."""
    words = [_plain(name) for name in header]
    if not kind.known or None in (_column(words, SECONDS), _column(words, NANOSECONDS)):
        return None
    integers, known = ("seconds", "nanoseconds", *kind.integers[1:]), (SECONDS, NANOSECONDS, *kind.known[1:])
    return replace(kind, integers=integers, known=known, split=True)


def places_given(kind: TableKind, header: Sequence[str], columns: Sequence[str], n: int) -> np.ndarray | str:
    """As `places_by_name`, from `columns` of the rig file: header names or numbers from 1 on, in the order of
    `kind.names`. n: number of columns of the table. Returns text for an error message if they are wrong."""
    if len(columns) != len(kind.names):
        return f"needs {len(kind.names)} names, for {', '.join(kind.names)}, but has {len(columns)}"
    names = {name.strip(): at for at, name in enumerate(header)} or {str(k + 1): k for k in range(n)}
    plain = {_bare(name): at for name, at in names.items()}
    places = [names.get(c.strip(), plain.get(_bare(c))) for c in columns]
    if None in places:
        have = ", ".join(names) if header else f"no header, only columns 1 to {n}"
        return f"has {columns[places.index(None)]!r}, but the table has {have}"
    if len(set(places)) < len(places):
        return "has a column twice"
    return _place_of_each(n, [at for at in places if at is not None])


def contradicts(kind: TableKind, header: Sequence[str]) -> bool:
    """True if a header name belongs to a column at another position than in `kind`."""
    words = [_plain(name) for name in header]
    places = [_column(words, known) for known in kind.known]
    return any(at not in (None, k) for k, at in enumerate(places))


def _place_of_each(n: int, places: Sequence[int]) -> np.ndarray:
    place = np.full(n, LEFT_OUT, np.int64)
    place[list(places)] = np.arange(len(places))
    return place


def _column(words: Sequence[str], known: Sequence[str]) -> int | None:
    """Index of the only word that matches the first pattern of `known` with any match; None if none or several do."""
    for name in known:
        matches = [at for at, word in enumerate(words) if re.fullmatch(name, word)]
        if matches:
            return matches[0] if len(matches) == 1 else None
    return None


def _bare(name: str) -> str:
    """The name without unit and quotes."""
    return _UNIT.sub("", name).strip().strip("\"'").strip()


def _plain(name: str) -> str:
    """The name in snake case, without unit and prefixes (`_FROM`)."""
    parts = re.split(r"[^A-Za-z0-9]+", _CAMEL.sub("_", _bare(name)))
    plain = "_".join(p.lower() for p in parts if p)
    while prefix := _FROM.match(plain):
        plain = plain[prefix.end() :]
    return plain


def in_axes(values: np.ndarray, axes: Axes | None) -> np.ndarray:
    """Vectors (N, 3) with components reordered and negated by `axes`, the source components of x, y and z, such as
    ("y", "-x", "z"). Unchanged if `axes` is None."""
    if axes is None:
        return values
    columns = ["xyz".index(entry[-1]) for entry in axes]
    return values[:, columns] * [-1.0 if entry.startswith("-") else 1.0 for entry in axes]


# Stamps for images without timestamps, from the rows of a pose table (hand-eye calibration).
#
# The robot stops, takes an image, and logs a pose. Images and rows are matched by order or by number.

_IMAGE_RATE_HZ = (1e-3, 1000.0)  # names are stamps only if they make an image rate within this range


def numbered_pictures(folder: Path, note: Note = ignore) -> list[tuple[int, Path]]:
    """Number and file of each image in `folder` or its subfolder `data`, sorted by number.

    The number is the last one in the file name. Empty without images, if they have stamps (`data.csv`, or names that
    are stamps), or if most names have no number. note: see `are_most`.
    """
    data = pictures_in(folder / "data")
    files = data or pictures_in(folder)
    if not files or (data and (folder / "data.csv").is_file()) or stamped_by_name(files) is not None:
        return []
    images = sorted((int(digits[-1]), path) for path in files if (digits := re.findall(r"\d+", path.stem)))
    if not are_most([path for _, path in images], files, note):
        return []
    numbers = np.array([number for number, _ in images], dtype=object)
    stamps = data and all(path.stem.isdecimal() for _, path in images) and numbers[-1] < 2**63
    return [] if stamps and is_rate(numbers.astype(np.int64), *_IMAGE_RATE_HZ) else images


def stamped_by_rows(
    images: list[tuple[int, Path]], table: Path, read: Callable[[], tuple[dict[int, int], int]], note: Note
) -> list[tuple[int, Path]]:
    """Stamp [ns] and file of each image of `images` (from `numbered_pictures`); the stamp is that of a row of `table`.

    With as many images as rows, they are matched in order. Otherwise the number of an image is its row, counted from 0
    if there is an image 0, else from 1. A note says which. read: returns stamps by row and the number of rows, as
    `TableFile.rows`. Images of unreadable rows are rejected, with a note. Raises RecordingError for two images of the
    same number, for an image without a row, and (by `read`) if many rows are unreadable.
    """
    folder, numbers = images[0][1].parent, [number for number, _ in images]
    _refuse_twice(images)
    stamp_of, count = read()
    in_order = len(numbers) == count
    first = min(1, numbers[0])  # the number of the first row
    rows = list(range(len(numbers))) if in_order else [n - first for n in numbers]
    if rows[-1] >= count:
        raise RecordingError(
            f"{folder} holds {len(images)} images without timestamps, up to number {numbers[-1]}, and {table} "
            f"has {count} rows; number each image as the row of its pose, or use stamps as file names."
        )
    how = "in order" if in_order else f"by number, {first} being that of the first row"
    sentence = (
        f"{folder}: {len(images)} images have no timestamps. Each takes that of its row of {table}, {how}: "
        f"image {images[0][1].name} belongs to row {rows[0] + 1}."
    )
    note(Remark("images_stamped_by_rows", sentence))
    paths = [path for _, path in images]
    lost = [path for row, path in zip(rows, paths, strict=True) if row not in stamp_of]
    if lost:
        sentence = (
            f"{folder}: {len(lost)} of {len(images)} images are ignored, the first is {lost[0].name}: the row "
            f"of its pose in {table} cannot be read."
        )
        note(Remark("images_of_unreadable_rows", sentence))
    return [(stamp_of[row], path) for row, path in zip(rows, paths, strict=True) if row in stamp_of]


def _refuse_twice(images: list[tuple[int, Path]]) -> None:
    """Raises RecordingError if two images, sorted by number, have the same number."""
    for (number, path), (other, second) in pairwise(images):
        if number == other:
            raise RecordingError(
                f"{path} and {second.name} have the same number, {number}; number each image as the row of its pose."
            )
