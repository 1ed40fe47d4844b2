"""Identification of the columns of a table: by the names in its header, by the rig file, or by their order.

Permutation and signs of vector components as the rig file states.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.data.stamps.clocks import TimeUnit
from icalib.data.tables.table_kernels import LEFT_OUT
from icalib.rig import Axes

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
    return _places(len(header), [at for at in places if at is not None])


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
    return _places(n, [at for at in places if at is not None])


def contradicts(kind: TableKind, header: Sequence[str]) -> bool:
    """True if a header name belongs to a column at another position than in `kind`."""
    words = [_plain(name) for name in header]
    places = [_column(words, known) for known in kind.known]
    return any(at not in (None, k) for k, at in enumerate(places))


def _places(n: int, places: Sequence[int]) -> np.ndarray:
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
