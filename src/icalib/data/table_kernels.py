"""Kernels of `table`: parse comma-separated numbers, integers exactly, decimals within 2 ulp."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit

POWERS = np.array([float(f"1e{k}") for k in range(309)])
LEFT_OUT = -1  # `place` of a column that is not read


@njit(cache=True, nogil=True)
def parse(
    buffer: np.ndarray,
    start: tuple[int, int],
    stamps: tuple[int, int],
    place: np.ndarray,
    powers: np.ndarray,
    integers: np.ndarray,
    decimals: np.ndarray,
    numbers: np.ndarray,
) -> tuple[int, int, int, int]:
    """Parse rows from `start` (byte, line) on. Returns the number of rows, the number of unreadable lines, and line and
    column of the first of these (line 0: none).
    place (n_columns,): target column of each column of the file, first all integers, then all decimals, or LEFT_OUT.
    stamps: number of stamp columns, and the power of ten to multiply stamps by; negative: stamps must be integers.
    numbers (n,) int64: index of each row in the file, which includes unreadable lines.
    """
    at, line = start
    row, bad, bad_line, bad_column = 0, 0, 0, 0
    while at < buffer.size:
        at = _skip_blank(buffer, at)
        if at >= buffer.size or buffer[at] == 10 or buffer[at] == 35:  # end, newline, #
            at = _next_line(buffer, at)
        else:
            # int(): the literal 0 is another numba type and would compile `_row` twice
            at, column = _row(buffer, at, int(row), stamps, place, powers, integers, decimals)
            if column == place.size:
                numbers[row] = row + bad
                row += 1
            elif bad == 0:
                bad, bad_line, bad_column = 1, line, column
            else:
                bad += 1
            at = _next_line(buffer, at)
        line += 1
    return row, bad, bad_line, bad_column


@njit(cache=True, nogil=True)
def _row(
    buffer: np.ndarray,
    at: int,
    row: int,
    stamps: tuple[int, int],
    place: np.ndarray,
    powers: np.ndarray,
    integers: np.ndarray,
    decimals: np.ndarray,
) -> tuple[int, int]:
    """Position at the end of the row, in its line, and the number of columns that could be parsed. Fills `row` of
    integers and decimals."""
    n, n_int = buffer.size, integers.shape[1]
    for column in range(place.size):
        to, ok = place[column], True
        if to < 0:
            at = _skip_field(buffer, at)
        elif to >= n_int:
            at, decimals[row, to - n_int], ok = _decimal(buffer, at, powers)
        elif to < stamps[0] and stamps[1] >= 0:
            at, integers[row, to], ok = _stamp(buffer, at, stamps[1])
        else:
            at, integers[row, to], ok = _integer(buffer, at)
        at = _skip_blank(buffer, at)
        ended = at >= n or buffer[at] == 10
        if not ok or (not ended if column == place.size - 1 else ended or buffer[at] != 44):
            return at, column
        at += 1
    return at - 1, place.size


@njit(cache=True, nogil=True)
def _next_line(buffer: np.ndarray, at: int) -> int:
    while at < buffer.size and buffer[at] != 10:
        at += 1
    return at + 1


@njit(cache=True, nogil=True, inline="always")
def _skip_field(buffer: np.ndarray, at: int) -> int:
    while at < buffer.size and buffer[at] != 44 and buffer[at] != 10:
        at += 1
    return at


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


@njit(cache=True, nogil=True, inline="always")
def _stamp(buffer: np.ndarray, at: int, power: int) -> tuple[int, np.int64, bool | np.bool_]:
    """Position after the number, the number times 10^power, rounded, and whether the result is an int64. Digits of the
    fraction beyond int64 are ignored."""
    at, negative = _sign(buffer, _skip_blank(buffer, at))
    value, digits, fraction, ok, full = np.int64(0), 0, False, True, False
    while at < buffer.size:
        c = buffer[at]
        if 48 <= c <= 57:
            digit = np.int64(c) - 48
            fits = value <= (9223372036854775807 - digit) // 10
            full = full or (fraction and not fits)
            ok = ok and (fits or fraction)
            if fits and not full:
                value = value * 10 + digit
                power -= fraction
            digits += 1
        elif c == 46 and not fraction:
            fraction = True
        else:
            break
        at += 1
    if digits > 0 and at < buffer.size and (buffer[at] == 101 or buffer[at] == 69):  # e, E
        at, exponent, good = _integer(buffer, at + 1)
        power += int(min(max(exponent, -1000), 1000))
        ok = ok and good
    value, fits = _shifted(value, power)
    return at, -value if negative else value, ok and fits and digits > 0


@njit(cache=True, nogil=True, inline="always")
def _shifted(value: np.int64, power: int) -> tuple[np.int64, bool]:
    """value * 10^power, rounded, for value >= 0, and whether it fits into int64."""
    while power > 0 and value > 0:
        if value > 9223372036854775807 // 10:
            return value, False
        value *= 10
        power -= 1
    while power < -1 and value > 0:
        value //= 10
        power += 1
    return (value // 10 + (value % 10 >= 5), True) if power < 0 else (value, True)


@njit(cache=True, nogil=True)
def _decimal(buffer: np.ndarray, at: int, powers: np.ndarray) -> tuple[int, float, bool]:
    """Position after the number, its value, and whether it is finite. Digits after the 18th count as zeros."""
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
    """mantissa * 10^exponent. Negative exponents divide by an exact power (one rounding; its inverse would add one)."""
    if mantissa == 0.0 or exponent < -616:
        return 0.0
    if exponent < -308:
        return mantissa / powers[308] / powers[-exponent - 308]
    if exponent < 0:
        return mantissa / powers[-exponent]
    return mantissa * powers[exponent] if exponent <= 308 else np.inf
