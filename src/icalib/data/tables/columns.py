"""Which column of a table is which: by the names in its header, by the rig file, or by their order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.data.tables.table_kernels import LEFT_OUT
from icalib.rig import TimeUnit

_UNIT = re.compile(r"\[[^]]*\]|\([^)]*\)")
_CAMEL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")
# Where a column is from, not what it is: prefixes of rostopic, and of sensors.
_FROM = re.compile(r"(field|msg|data|imu|imu\d+|odom|pose\d*|transform|twist|sensor|world)_(?=[a-z])")
STAMP = (r"(header_)?stamp(_ns|_nsec)?", r"time_?stamp(_ns|_us|_ms|_s)?", r"(time|t|ts)(_ns|_us|_ms|_s)?")
# A stamp in two columns, as of messages of ROS: whole seconds, and nanoseconds beyond them.
_OF_STAMP = r"((header_)?stamp_|time_?stamp_|time_|ros_?time_)?"
SECONDS = tuple(rf"{of}(secs?|seconds?)" for of in (r"(header_)?stamp_", _OF_STAMP))
NANOSECONDS = tuple(rf"{of}(n_?secs?|nano_?secs?|nano_?seconds?)" for of in (r"(header_)?stamp_", _OF_STAMP))


@dataclass(frozen=True)
class TableKind:
    """The columns of a kind of table: whole numbers, the stamps first, whose names end in [ns]; then decimals.

    known: for each of these regular expressions of names that headers give it, the most telling first; none: only the
    order counts. rate_hz: the slowest and the fastest rate of stamps, by which their unit is told where it is not
    `unit`; None: it is. more: whether further columns may follow that no header names. split: whether the first two
    whole numbers are one stamp, its seconds and its nanoseconds.
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
        """How many of the integers are stamps, or parts of a split one."""
        return 2 if self.split else sum(name.endswith("[ns]") for name in self.integers)


def vector_names(quantities: str, axes: str = "xyz") -> tuple[tuple[str, ...], ...]:
    """Names of the components of a vector; quantities: a regular expression of what it may be called."""
    return tuple((rf"({quantities})_?{axis}", rf"{axis}_?({quantities})") for axis in axes)


def places_by_name(kind: TableKind, header: Sequence[str]) -> np.ndarray | None:
    """(n,) where each column of the header goes, LEFT_OUT for others; None where the names do not tell.

    One column without a known name is the one that is missing, where nothing else is left over.
    """
    if not kind.known or len(header) < len(kind.names):
        return None
    words = [_plain(name) for name in header]
    found = [_column(words, known) for known in kind.known]
    missing = [k for k, at in enumerate(found) if at is None]
    left = [at for at in range(len(words)) if at not in found]
    if len(missing) == 1 and len(left) == 1:
        found[missing[0]], missing = left[0], []
    if missing or len(set(found)) < len(found):
        return None
    return _places(len(header), [at for at in found if at is not None])


def split_kind(kind: TableKind, header: Sequence[str]) -> TableKind | None:
    """The kind with its stamp in two columns, where the header names both; None elsewhere."""
    words = [_plain(name) for name in header]
    if not kind.known or None in (_column(words, SECONDS), _column(words, NANOSECONDS)):
        return None
    integers, known = ("seconds", "nanoseconds", *kind.integers[1:]), (SECONDS, NANOSECONDS, *kind.known[1:])
    return replace(kind, integers=integers, known=known, split=True)


def places_given(kind: TableKind, header: Sequence[str], columns: Sequence[str], n: int) -> np.ndarray | str:
    """The same for `columns` in the order of the kind, names of the header or numbers from 1 on, of n columns; or a
    sentence on what is wrong with them."""
    if len(columns) != len(kind.names):
        return f"needs {len(kind.names)} names, for {', '.join(kind.names)}, but has {len(columns)}"
    names = {name.strip(): at for at, name in enumerate(header)} or {str(k + 1): k for k in range(n)}
    plain = {_bare(name): at for name, at in names.items()}
    found = [names.get(c.strip(), plain.get(_bare(c))) for c in columns]
    if None in found:
        have = ", ".join(names) if header else f"no header, only columns 1 to {n}"
        return f"has {columns[found.index(None)]!r}, but the table has {have}"
    if len(set(found)) < len(found):
        return "has a column twice"
    return _places(n, [at for at in found if at is not None])


def contradicts(kind: TableKind, header: Sequence[str]) -> bool:
    """Whether some name of the header is known for another column than the one in its place."""
    words = [_plain(name) for name in header]
    found = [_column(words, known) for known in kind.known]
    return any(at not in (None, k) for k, at in enumerate(found))


def _places(n: int, found: Sequence[int]) -> np.ndarray:
    place = np.full(n, LEFT_OUT, np.int64)
    place[list(found)] = np.arange(len(found))
    return place


def _column(words: Sequence[str], known: Sequence[str]) -> int | None:
    """The only column with one of the names, the most telling that is there; None where there are none or several."""
    for name in known:
        found = [at for at, word in enumerate(words) if re.fullmatch(name, word)]
        if found:
            return found[0] if len(found) == 1 else None
    return None


def _bare(name: str) -> str:
    """Without unit and quotes."""
    return _UNIT.sub("", name).strip().strip("\"'").strip()


def _plain(name: str) -> str:
    """A name in small letters and underscores, without its unit and what it is from."""
    parts = re.split(r"[^A-Za-z0-9]+", _CAMEL.sub("_", _bare(name)))
    plain = "_".join(p.lower() for p in parts if p)
    while prefix := _FROM.match(plain):
        plain = plain[prefix.end() :]
    return plain
