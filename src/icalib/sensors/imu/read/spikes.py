"""Single readings of an IMU that are wrong: spikes, and values that a driver repeats instead of measuring.

A reading is compared with the straight line between its neighbours, in units of the local spread of such differences
(Hampel's identifier). What an IMU measures is band-limited by its own low-pass filter: a shock spreads over several
readings, and its neighbours stand off, too. A spike leaves them in line once it is taken out.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

_MAX_DEVIATIONS = 10.0  # robust standard deviations off its neighbours; white noise comes as far once in 1e22 readings
_MAX_NEIGHBOUR_DEVIATIONS = 5.0  # of the neighbours, once the spike is out
_HALF_WINDOW = 10  # readings to each side that show the local spread
_MAX_RUN = 3  # readings in a row that are single wrong ones by chance
_MAX_COSINE = 0.5  # cosine between deviations of neighbours: a shock pushes one way, wrong readings in a row do not
_MAX_OUTLIER_SHARE = 0.2  # of readings that stand off: then these are no single wrong ones
_MAX_RELATIVE_FORCE = 100.0  # times the usual size of an accelerometer's readings: no sensor's range
_MAX_RATE = 1e4  # in rad/s or deg/s
_MAX_SQUARABLE = 1e150  # whose square is a number, too
_MIN_REPEATS = 3  # repeats in a row
_MIN_JUMP = 8.0  # usual steps by which a reading differs from the one before, after the sensor was stuck
_MAD_TO_SIGMA = 1.4826


def spikes(seconds: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N,) bool: which readings (N, 3) at seconds (N,) are single wrong ones."""
    bad = np.zeros(len(values), bool)
    if len(values) < 4 * _HALF_WINDOW:
        return bad
    flag = _stands_off(seconds, values, _MAX_DEVIATIONS)
    flag[1:-1] |= flag[:-2] & flag[2:]  # two wrong ones to opposite sides leave the one between them in line
    for _ in range(2):  # one found may have hidden another near it
        good = np.flatnonzero(~bad)
        t, x = seconds[good], values[good]
        for run in _runs(flag[good]):
            for own in _within(run, len(good)):
                if _is_wrong(t, x, own):
                    bad[good[own]] = True
                    break
    return bad


def impossible(values: np.ndarray, is_gyro: bool) -> np.ndarray:
    """(N,) bool: readings (N, 3) beyond any sensor's range, or not finite."""
    size = np.linalg.norm(squarable(np.where(np.isfinite(values), values, np.inf)), axis=1)
    limit = _MAX_RATE if is_gyro else _MAX_RELATIVE_FORCE * max(float(np.median(size)), 1e-9)
    return ~(size <= limit) | ~np.isfinite(values).all(axis=1)


def squarable(values: np.ndarray) -> np.ndarray:
    """The same, numbers whose squares would overflow made smaller: none of them is a measurement."""
    return np.clip(values, -_MAX_SQUARABLE, _MAX_SQUARABLE)


def stuck(values: np.ndarray) -> np.ndarray:
    """(N,) bool: readings (N, 3) that repeat the one before exactly, several in a row, after which they jump."""
    step = np.linalg.norm(np.diff(squarable(values), axis=0), axis=1)
    bad = np.zeros(len(values), bool)
    for begin, end in _runs(np.concatenate([[False], step == 0.0])):
        if end - begin < _MIN_REPEATS or end >= len(values):
            continue
        around = np.concatenate(
            [step[max(begin - 1 - 2 * _HALF_WINDOW, 0) : begin - 1], step[end : end + 2 * _HALF_WINDOW]]
        )
        if len(around) and step[end - 1] > _MIN_JUMP * np.median(around) > 0.0:
            bad[begin:end] = True
    return bad


def _stands_off(seconds: np.ndarray, values: np.ndarray, far: float) -> np.ndarray:
    """(N,) bool: further than `far` local standard deviations off the line between its neighbours, on some axis."""
    off = _off_line(seconds, values, np.arange(1, len(values) - 1), 1)
    # Half the spread over all readings at least: where little moves the local one is small by chance.
    least = _MAD_TO_SIGMA * 0.5 * np.median(off, axis=0) + _digit(values)
    some = np.flatnonzero((off > far * least).any(axis=1))
    window = np.clip(some[:, None] + np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1), 0, len(off) - 1)
    local = _MAD_TO_SIGMA * np.median(off[window], axis=1) + _digit(values)
    flag = np.zeros(len(values), bool)
    flag[1 + some] = (off[some] > far * np.maximum(local, least)).any(axis=1)
    return flag & (flag.mean() < _MAX_OUTLIER_SHARE)


def _digit(values: np.ndarray) -> np.ndarray:
    """(3,) the smallest step between readings (N, 3): the last digit of coarse ones."""
    step = np.abs(np.diff(values, axis=0))
    return np.where(step > 0.0, step, np.inf).min(axis=0, initial=1e300)


def _off_line(seconds: np.ndarray, values: np.ndarray, at: np.ndarray, reach: int) -> np.ndarray:
    """(n, 3) distance of readings `at` from the line between those `reach` before and after."""
    before, after = at - reach, at + reach
    share = ((seconds[at] - seconds[before]) / np.maximum(seconds[after] - seconds[before], 1e-12))[:, None]
    return np.abs(values[at] - (1.0 - share) * values[before] - share * values[after])


def _runs(flag: np.ndarray) -> list[tuple[int, int]]:
    """First index and the one after the last of each run of True."""
    edge = np.diff(np.concatenate([[0], flag.astype(np.int8), [0]]))
    return list(zip(np.flatnonzero(edge == 1).tolist(), np.flatnonzero(edge == -1).tolist(), strict=True))


def _within(run: tuple[int, int], n: int) -> Iterator[np.ndarray]:
    """Indices of what may be wrong in a run of readings that stand off, as neighbours of a wrong one do, too: one, two
    near each other, or three in a row."""
    begin, end = run
    if end - begin > 2 * _MAX_RUN + 4:
        return
    one = range(max(begin, 2), min(end, n - 2))
    yield from (np.array([k]) for k in one)
    yield from (np.array(pair) for pair in combinations(one, 2))
    yield from (np.array([k, k + 1, k + 2]) for k in one[:-2])


def _is_wrong(seconds: np.ndarray, values: np.ndarray, own: np.ndarray) -> bool:
    """Whether the readings `own` stand off, are no shock, and all around them are in line once they are out."""
    low, high = max(own[0] - 2 * _HALF_WINDOW, 0), min(own[-1] + 2 * _HALF_WINDOW + 1, len(values))
    others = np.setdiff1d(np.arange(low, high), own, assume_unique=True)
    t, x = seconds[others], values[others]
    off = _off_line(t, x, np.arange(1, len(others) - 1), 1)
    scale = _MAD_TO_SIGMA * np.median(off, axis=0) + 1e-300
    away = values[own] - np.stack([np.interp(seconds[own], t, x[:, k]) for k in range(3)], axis=1)
    if not (np.abs(away) > _MAX_DEVIATIONS * scale).any(axis=1).all():
        return False
    edge = own[0] - low
    if (off[max(edge - 3, 0) : edge + 1 + own[-1] - own[0]] > _MAX_NEIGHBOUR_DEVIATIONS * scale).any():
        return False
    unit = away / np.linalg.norm(away, axis=1, keepdims=True)
    alike = (unit[1:] * unit[:-1]).sum(axis=1) > _MAX_COSINE
    return not (alike & (np.diff(own) == 1)).any()
