"""Finds readings of an IMU that a driver sent twice with different stamps, or repeated until it had a new one."""

from __future__ import annotations

import numpy as np

from icalib.data.stamps.clocks import usual_step

_MAX_COPY_STEP = 0.75  # [periods]; the step from a copy to its nearest neighbour is shorter
_MAX_DELAY_NS = 1_000_000_000  # between a reading and its copy
_PERIOD_QUANTILE = 0.3  # this quantile of the steps between readings without a copy is taken as the period
_MAX_UNEVENNESS_RATIO = 0.5  # the later twins are the originals if their unevenness is below this share
_MIN_SINGLE = 20  # readings without a copy from which the period is estimated
_MIN_REPEATED_SHARE = 0.25  # of the readings are repeats if the driver repeats them
_MIN_REGULAR_SHARE = 0.9  # of the runs of equal readings have the median length, give or take one reading


def copies(stamps_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N,) bool: readings (N, m) that are exact copies of another and closer than a period to a neighbour; stamps (N,)
    [ns] must not decrease.

    All copies are assumed to be on the same side, before or after their originals. The originals are the later twins
    if these are much more evenly spaced, otherwise the earlier ones.
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
    """(N,) bool: readings (N, 3) that differ from the one before. None unless the driver repeats each about equally
    often until it has a new one."""
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
    """(n, 2) indices, the earlier first, of readings with equal values and different stamps less than _MAX_DELAY_NS
    apart. Values that occur more than twice are excluded: they come from coarse quantisation."""
    order = np.lexsort((*values.T, np.zeros(len(values))))
    same = (np.diff(values[order], axis=0) == 0.0).all(axis=1)
    same &= ~(np.append(same[1:], False) | np.insert(same[:-1], 0, False))
    pairs = np.sort(np.stack([order[:-1][same], order[1:][same]], axis=1), axis=1)
    step = stamps_ns[pairs[:, 1]] - stamps_ns[pairs[:, 0]]
    return pairs[(step > 0) & (step < _MAX_DELAY_NS)]


def _uneven(known_ns: np.ndarray, stamps_ns: np.ndarray, period: float) -> np.ndarray:
    """(n,) deviation [periods] of stamps (n,) from a whole number of periods, summed over the known stamp before and
    the one after; known_ns is sorted."""
    after = np.clip(np.searchsorted(known_ns, stamps_ns), 1, len(known_ns) - 1)
    off = [np.abs(stamps_ns - known_ns[k]) / period for k in (after - 1, after)]
    return sum((np.abs(x - np.maximum(np.round(x), 1.0)) for x in off), np.zeros(len(stamps_ns)))


def _nearest(stamps_ns: np.ndarray) -> np.ndarray:
    """(N,) step [ns] from each reading to the nearer neighbour."""
    step = np.diff(stamps_ns).astype(np.float64)
    return np.minimum(np.append(step, np.inf), np.insert(step, 0, np.inf))
