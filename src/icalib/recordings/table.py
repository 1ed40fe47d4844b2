"""Numeric tables (csv, gzip or not): integer columns, then decimal columns, read exactly and fast."""

from __future__ import annotations

import gzip
import zlib
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np
from numba import njit

from icalib.errors import RecordingError

_GZIP_MAGIC = b"\x1f\x8b"
_POWERS = np.array([float(f"1e{k}") for k in range(309)])


@dataclass(frozen=True)
class Table:
    """Rows of a table. integers (N, I) int64, decimals (N, D) float64."""

    path: Path
    integers: np.ndarray
    decimals: np.ndarray


def read_table(path: Path, integer_columns: tuple[str, ...], decimal_columns: tuple[str, ...]) -> Table:
    """Read a table whose columns are `integer_columns`, then `decimal_columns`, separated by commas.

    Blank lines and lines that start with # are skipped, and so is one header line of text. Integers are exact;
    decimals are within 1 ulp or two of the written number. Raises RecordingError naming file, line and column.
    """
    content = _read_bytes(path)
    begin, first_line = _skip_header(content)
    buffer = np.frombuffer(content, dtype=np.uint8)
    n_int, n_dec = len(integer_columns), len(decimal_columns)
    capacity = content.count(b"\n", begin) + 1
    integers = np.empty((capacity, n_int), dtype=np.int64)
    decimals = np.empty((capacity, n_dec))
    rows, bad_line, bad_column = _parse(buffer, begin, first_line, _POWERS, integers, decimals)
    if bad_line:
        names = integer_columns + decimal_columns
        raise RecordingError(_describe(path, content, bad_line, bad_column, names, n_int))
    if rows == 0:
        columns = ", ".join(integer_columns + decimal_columns)
        raise RecordingError(f"{path} holds no rows; write one line for each reading, with the columns {columns}.")
    return Table(path, integers[:rows], decimals[:rows])


def columns_of(path: Path) -> int:
    """How many columns the first row of a table has, 0 if there is none. Raises RecordingError as `read_table`."""
    content = _read_bytes(path)
    for line in content[_skip_header(content)[0] :].splitlines():
        if line.strip() and not line.lstrip().startswith(b"#"):
            return line.count(b",") + 1
    return 0


def header_of(path: Path) -> str:
    """The last line of column names before the first row, with or without #; empty if there is none. Raises
    RecordingError as `read_table`."""
    content, header = _read_bytes(path), ""
    for line in content.splitlines():
        text = line.strip()
        if text and not text.startswith(b"#") and not text[:1].isalpha():
            break
        header = text.decode("utf-8", "replace") or header
    return header


def _read_bytes(path: Path) -> bytes:
    try:
        content = path.read_bytes()
        if path.suffix == ".gz" or content.startswith(_GZIP_MAGIC):
            content = gzip.decompress(content)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise RecordingError(f"{path} is a damaged or truncated gzip file ({error}); copy it again.") from error
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be read ({error.strerror or error}); check the file and its permissions."
        ) from error
    if not content.strip():
        raise RecordingError(f"{path} is empty; record or export it again.")
    return content.removeprefix(b"\xef\xbb\xbf")


def _skip_header(content: bytes) -> tuple[int, int]:
    """Where the data begin (offset and line): after one line of column names without #, which starts with a letter."""
    begin, line = 0, 1
    while begin < len(content):
        end = content.find(b"\n", begin)
        end = len(content) if end < 0 else end + 1
        text = content[begin:end].strip()
        if text and not text.startswith(b"#"):
            is_header = text[:1].isalpha() or text[:1] in b"\"'"
            return (end, line + 1) if is_header and not _is_number(text.split(b",")[0]) else (begin, line)
        begin, line = end, line + 1
    return begin, line


def _is_number(text: bytes) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _describe(path: Path, content: bytes, line: int, column: int, names: tuple[str, ...], n_int: int) -> str:
    """The sentence for a row that the kernel refused; it is read again here, where speed does not matter."""
    row = content.split(b"\n")[line - 1].decode("utf-8", "replace").strip()
    fields = [f.strip() for f in row.split(",")]
    place = f"{path}:{line}"
    if len(fields) != len(names):
        wanted = f"{len(names)} ({', '.join(names)})"
        return f"{place}: the line has {len(fields)} columns instead of {wanted}; correct or remove it."
    name, text = names[column], fields[column]
    shown = text if len(text) <= 40 else text[:40] + "..."
    try:
        number = float(text)
    except ValueError:
        return f"{place}: {name} is {shown!r}, which is not a number; correct or remove the line."
    if not isfinite(number):
        return f"{place}: {name} is {shown}, which is not a finite number; remove the line."
    if column < n_int:
        hint = " (stamps in seconds must be multiplied by 1e9 when exporting)" if name.endswith("[ns]") else ""
        return f"{place}: {name} is {shown}, but must be a whole number below 2^63{hint}."
    return f"{place}: {name} is {shown!r}, which is not written as a plain decimal number; correct the line."


@njit(cache=True, nogil=True)
def _parse(
    buffer: np.ndarray,
    begin: int,
    first_line: int,
    powers: np.ndarray,
    integers: np.ndarray,
    decimals: np.ndarray,
) -> tuple[int, int, int]:
    """Fill the rows; returns their number and line and column of the first bad field (line 0: none)."""
    n, n_int = buffer.size, integers.shape[1]
    n_columns = n_int + decimals.shape[1]
    at, line, row = begin, first_line, 0
    while at < n:
        at = _skip_blank(buffer, at)
        if at >= n or buffer[at] == 10 or buffer[at] == 35:  # end, newline, #
            while at < n and buffer[at] != 10:
                at += 1
            at += 1
            line += 1
            continue
        for column in range(n_columns):
            if column < n_int:
                at, integers[row, column], ok = _integer(buffer, at)
            else:
                at, decimals[row, column - n_int], ok = _decimal(buffer, at, powers)
            at = _skip_blank(buffer, at)
            last = column == n_columns - 1
            ends = at >= n or buffer[at] == 10 if last else at < n and buffer[at] == 44
            if not (ok and ends):
                return row, line, column
            at += 1
        row += 1
        line += 1
    return row, 0, 0


@njit(cache=True, nogil=True)
def _skip_blank(buffer: np.ndarray, at: int) -> int:
    while at < buffer.size and (buffer[at] == 32 or buffer[at] == 9 or buffer[at] == 13):
        at += 1
    return at


@njit(cache=True, nogil=True)
def _sign(buffer: np.ndarray, at: int) -> tuple[int, bool]:
    if at < buffer.size and (buffer[at] == 43 or buffer[at] == 45):
        return at + 1, buffer[at] == 45
    return at, False


@njit(cache=True, nogil=True)
def _integer(buffer: np.ndarray, at: int) -> tuple[int, np.int64, bool]:
    """Position after the number, its value, and whether it is an int64."""
    at, negative = _sign(buffer, _skip_blank(buffer, at))
    value, digits, ok = np.int64(0), 0, True
    while at < buffer.size and 48 <= buffer[at] <= 57:
        digit = np.int64(buffer[at]) - 48
        if value > (9223372036854775807 - digit) // 10:
            ok = False
        value = value * 10 + digit
        digits += 1
        at += 1
    return at, -value if negative else value, ok and digits > 0


@njit(cache=True, nogil=True)
def _decimal(buffer: np.ndarray, at: int, powers: np.ndarray) -> tuple[int, float, bool]:
    """Position after the number, its value, and whether it is a finite number. Digits after the 18th only scale."""
    at, negative = _sign(buffer, _skip_blank(buffer, at))
    mantissa, exponent, digits, fraction = np.int64(0), 0, 0, False
    while at < buffer.size:
        c = buffer[at]
        if 48 <= c <= 57:
            if mantissa < 100000000000000000:
                mantissa = mantissa * 10 + (np.int64(c) - 48)
                exponent -= fraction
            else:
                exponent += not fraction
            digits += 1
        elif c == 46 and not fraction:
            fraction = True
        else:
            break
        at += 1
    ok = digits > 0
    if ok and at < buffer.size and (buffer[at] == 101 or buffer[at] == 69):  # e, E
        at, power, ok = _integer(buffer, at + 1)
        exponent += int(min(max(power, -100000), 100000))
    value = _scale(float(mantissa), exponent, powers)
    return at, -value if negative else value, ok and np.isfinite(value)


@njit(cache=True, nogil=True)
def _scale(mantissa: float, exponent: int, powers: np.ndarray) -> float:
    """mantissa * 10^exponent; a division by an exact power rounds once, a product with its inverse twice."""
    if mantissa == 0.0 or exponent < -616:
        return 0.0
    if exponent < -308:
        return mantissa / powers[308] / powers[-exponent - 308]
    if exponent < 0:
        return mantissa / powers[-exponent]
    return mantissa * powers[exponent] if exponent <= 308 else np.inf
