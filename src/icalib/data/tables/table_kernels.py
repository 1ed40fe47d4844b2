"""The kernels of `table`: rows of numbers between commas, integers exactly, decimals within 1 ulp or two."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit

POWERS = np.array([float(f"1e{k}") for k in range(309)])
LEFT_OUT = -1  # of a column's place


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
    """Fill the rows from byte and line `start`. place (n_columns,): where each column of the file goes, first all
    integers, then all decimals, or LEFT_OUT. stamps: how many of the integers are stamps, and the power of ten to
    multiply these by; whole numbers only where it is negative. numbers (n,) int64: filled with each row's number in the
    file, from 0 on; lines that cannot be read are counted.

    Returns the number of rows, and of lines that cannot be read, with line and column of the first (line 0: none).
    """
    at, line = start
    row, bad, bad_line, bad_column = 0, 0, 0, 0
    while at < buffer.size:
        at = _skip_blank(buffer, at)
        if at >= buffer.size or buffer[at] == 10 or buffer[at] == 35:  # end, newline, #
            at = _next_line(buffer, at)
        else:
            # int: the literal 0 would be a type of its own, for which all is compiled once more
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
    """Where the row ends, in its line, and how many of its columns could be read."""
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
    """Position after the number, the number times 10^power, rounded, and whether that is an int64. Digits of its
    fraction that do not fit are left out."""
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
    """value * 10^power of a value from 0 up, rounded, and whether it fits."""
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
