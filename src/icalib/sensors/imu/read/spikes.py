"""Outliers among the readings of an IMU: spikes, and values that a driver repeats instead of measuring.

A reading is compared with the straight line between its neighbours, in units of the local spread of such deviations
(Hampel's identifier). The low-pass filter of an IMU spreads a true shock over several readings, so that its neighbours
deviate too. After a spike is removed its neighbours deviate no longer.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from icalib.data.stamps.ordered import true_runs

_MAX_DEVIATIONS = 10.0  # robust standard deviations from the line; white noise exceeds it once in 1e22 readings
_MAX_NEIGHBOUR_DEVIATIONS = 5.0  # robust standard deviations of the neighbours after the spike is removed
_HALF_WINDOW = 10  # readings to each side from which the local spread is estimated
_MAX_RUN = 3  # spikes in a row that occur by chance
_MAX_COSINE = 0.5  # cosine between the deviations of neighbours; neighbours in a shock deviate in the same direction
_MAX_OUTLIER_SHARE = 0.2  # of all readings; if more deviate, none is taken for a spike
_MAX_RELATIVE_FORCE = 100.0  # times the median norm of the accelerometer's readings; beyond any sensor's range
_MAX_RATE = 1e4  # rad/s or deg/s; beyond any gyroscope's range
_MAX_SQUARABLE = 1e150  # its square does not overflow
_MIN_REPEATS = 3  # exact repeats in a row of a sensor that is stuck
_MIN_JUMP = 8.0  # median steps around a stuck run; the first reading after the run changes by more
_MAD_TO_SIGMA = 1.4826


def spikes(seconds: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N,) bool: readings (N, 3) at seconds (N,) that are spikes."""
    bad = np.zeros(len(values), bool)
    if len(values) < 4 * _HALF_WINDOW:
        return bad
    flag = _stands_off(seconds, values, _MAX_DEVIATIONS)
    flag[1:-1] |= flag[:-2] & flag[2:]  # a reading between two opposite spikes may lie on the line
    for _ in range(2):  # a spike may hide another one near it
        good = np.flatnonzero(~bad)
        t, x = seconds[good], values[good]
        for run in true_runs(flag[good]):
            for group in _within(run, len(good)):
                if _is_wrong(t, x, group):
                    bad[good[group]] = True
                    break
    return bad


def impossible(values: np.ndarray, is_gyro: bool) -> np.ndarray:
    """(N,) bool: readings (N, 3) of a gyroscope or accelerometer that are not finite or beyond any sensor's range."""
    size = np.linalg.norm(squarable(np.where(np.isfinite(values), values, np.inf)), axis=1)
    limit = _MAX_RATE if is_gyro else _MAX_RELATIVE_FORCE * max(float(np.median(size)), 1e-9)
    return ~(size <= limit) | ~np.isfinite(values).all(axis=1)


def squarable(values: np.ndarray) -> np.ndarray:
    """`values` clipped so that their squares do not overflow; no real measurement is affected."""
    return np.clip(values, -_MAX_SQUARABLE, _MAX_SQUARABLE)


def stuck(values: np.ndarray) -> np.ndarray:
    """(N,) bool: readings (N, 3) in a run of exact repeats that ends with a jump."""
    step = np.linalg.norm(np.diff(squarable(values), axis=0), axis=1)
    bad = np.zeros(len(values), bool)
    for begin, end in true_runs(np.concatenate([[False], step == 0.0])):
        if end - begin < _MIN_REPEATS or end >= len(values):
            continue
        around = np.concatenate(
            [step[max(begin - 1 - 2 * _HALF_WINDOW, 0) : begin - 1], step[end : end + 2 * _HALF_WINDOW]]
        )
        if len(around) and step[end - 1] > _MIN_JUMP * np.median(around) > 0.0:
            bad[begin:end] = True
    return bad


def _stands_off(seconds: np.ndarray, values: np.ndarray, far: float) -> np.ndarray:
    """(N,) bool: readings that deviate from the line between their neighbours by more than `far` local standard
    deviations on some axis. All False if too many readings do."""
    off = _off_line(seconds, values)
    # Lower bound: half the spread over all readings, as the local spread of a still sensor may be small by chance.
    least = _MAD_TO_SIGMA * 0.5 * np.median(off, axis=0) + _digit(values)
    some = np.flatnonzero((off > far * least).any(axis=1))
    window = np.clip(some[:, None] + np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1), 0, len(off) - 1)
    local = _MAD_TO_SIGMA * np.median(off[window], axis=1) + _digit(values)
    flag = np.zeros(len(values), bool)
    flag[1 + some] = (off[some] > far * np.maximum(local, least)).any(axis=1)
    return flag & (flag.mean() < _MAX_OUTLIER_SHARE)


def _digit(values: np.ndarray) -> np.ndarray:
    """(3,) smallest nonzero step between readings (N, 3) on each axis: the resolution of a quantised sensor."""
    step = np.abs(np.diff(values, axis=0))
    return np.where(step > 0.0, step, np.inf).min(axis=0, initial=1e300)


def _off_line(seconds: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N - 2, 3) distances of the inner readings (N, 3) from the line between their neighbours."""
    share = ((seconds[1:-1] - seconds[:-2]) / np.maximum(seconds[2:] - seconds[:-2], 1e-12))[:, None]
    return np.abs(values[1:-1] - (1.0 - share) * values[:-2] - share * values[2:])


def _within(run: tuple[int, int], n: int) -> Iterator[np.ndarray]:
    """Candidate sets of spike indices in a run of deviating readings, to which neighbours of a spike belong as well:
    one reading, any two, or three in a row. n: number of all readings."""
    begin, end = run
    if end - begin > 2 * _MAX_RUN + 4:
        return
    one = range(max(begin, 2), min(end, n - 2))
    yield from (np.array([k]) for k in one)
    yield from (np.array(pair) for pair in combinations(one, 2))
    yield from (np.array([k, k + 1, k + 2]) for k in one[:-2])


def _is_wrong(seconds: np.ndarray, values: np.ndarray, group: np.ndarray) -> bool:
    """True if the readings with indices `group` deviate, do not look like a shock, and their neighbours fit the line
    after their removal."""
    low, high = max(group[0] - 2 * _HALF_WINDOW, 0), min(group[-1] + 2 * _HALF_WINDOW + 1, len(values))
    others = np.setdiff1d(np.arange(low, high), group, assume_unique=True)
    t, x = seconds[others], values[others]
    off = _off_line(t, x)
    scale = _MAD_TO_SIGMA * np.median(off, axis=0) + 1e-300
    away = values[group] - np.stack([np.interp(seconds[group], t, x[:, k]) for k in range(3)], axis=1)
    if not (np.abs(away) > _MAX_DEVIATIONS * scale).any(axis=1).all():
        return False
    edge = group[0] - low
    if (off[max(edge - 3, 0) : edge + 1 + group[-1] - group[0]] > _MAX_NEIGHBOUR_DEVIATIONS * scale).any():
        return False
    unit = away / np.linalg.norm(away, axis=1, keepdims=True)
    alike = (unit[1:] * unit[:-1]).sum(axis=1) > _MAX_COSINE
    return not (alike & (np.diff(group) == 1)).any()
