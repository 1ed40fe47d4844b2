"""Readings of an IMU that a driver sent again under another stamp, or repeated until it had a new one."""

from __future__ import annotations

import numpy as np

from icalib.data.stamps.clocks import usual_step

_MAX_COPY_STEP = 0.75  # of the period: the step from a copy to its nearest neighbour is shorter
_MAX_DELAY_NS = 1_000_000_000  # between a reading and its copy
_PERIOD_QUANTILE = 0.3  # quantile of the steps between readings without a copy that is one period: no step is shorter
_MAX_UNEVENNESS_RATIO = 0.5  # as uneven: then these are the originals
_MIN_SINGLE = 20  # readings without a copy that show the period
_MIN_REPEATED_SHARE = 0.25  # of the readings, that a repeating driver repeats at least
_MIN_REGULAR_SHARE = 0.9  # of the runs are as long as the usual one, but for one reading


def copies(stamps_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N,) bool: readings (N, m) with the values of another exactly that lie between the others' stamps (N,), in order.

    A driver stamps its copies all too early, or all too late: originals are those that keep the stamps more even, the
    earlier ones where neither do.
    """
    bad = np.zeros(len(values), bool)
    if len(values) < 2 or np.diff(stamps_ns).min() >= _MAX_COPY_STEP * usual_step(stamps_ns):
        return bad
    twins = _twins(stamps_ns, values)
    single = np.ones(len(values), bool)
    single[twins.ravel()] = False
    if not len(twins):
        return bad
    if single.sum() < _MIN_SINGLE:
        single[twins[:, 0]] = True
    known = stamps_ns[single]
    period = float(np.quantile(np.diff(known), _PERIOD_QUANTILE))
    uneven = [np.median(_uneven(known, stamps_ns[twins[:, side]], period)) for side in (0, 1)]
    twin = twins[:, 0 if uneven[1] < _MAX_UNEVENNESS_RATIO * uneven[0] else 1]
    bad[twin[_nearest(stamps_ns)[twin] < _MAX_COPY_STEP * period]] = True
    return bad


def new_values(values: np.ndarray) -> np.ndarray | None:
    """(N,) bool: readings (N, 3) that are new, where a driver repeats each several times, about equally often, until it
    has the next; None where it does not."""
    new = np.concatenate([[True], (np.diff(values, axis=0) != 0.0).any(axis=1)])
    if (~new).mean() < _MIN_REPEATED_SHARE:
        return None
    length = np.diff(np.flatnonzero(new))
    if len(length) < 10:
        return None
    usual = float(np.median(length))
    regular = (length >= 2) & (np.abs(length - usual) <= 1.0)
    return new if regular.mean() > _MIN_REGULAR_SHARE else None


def _twins(stamps_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(n, 2) indices of two readings with the same values, at different stamps near each other. Values that three have
    are those of a coarse sensor."""
    order = np.lexsort((*values.T, np.zeros(len(values))))
    same = (np.diff(values[order], axis=0) == 0.0).all(axis=1)
    same &= ~(np.append(same[1:], False) | np.insert(same[:-1], 0, False))
    pairs = np.sort(np.stack([order[:-1][same], order[1:][same]], axis=1), axis=1)
    step = stamps_ns[pairs[:, 1]] - stamps_ns[pairs[:, 0]]
    return pairs[(step > 0) & (step < _MAX_DELAY_NS)]


def _uneven(known_ns: np.ndarray, stamps_ns: np.ndarray, period: float) -> np.ndarray:
    """(n,) how far stamps (n,) are off whole periods from the nearest of the known ones, in order; in periods."""
    after = np.clip(np.searchsorted(known_ns, stamps_ns), 1, len(known_ns) - 1)
    off = [np.abs(stamps_ns - known_ns[k]) / period for k in (after - 1, after)]
    return sum((np.abs(x - np.maximum(np.round(x), 1.0)) for x in off), np.zeros(len(stamps_ns)))


def _nearest(stamps_ns: np.ndarray) -> np.ndarray:
    """(N,) step [ns] from each reading to the nearer neighbour."""
    step = np.diff(stamps_ns).astype(np.float64)
    return np.minimum(np.append(step, np.inf), np.insert(step, 0, np.inf))
