"""Outliers in readings of wheels, and wrap-around of angles and encoder counters."""

from __future__ import annotations

import numpy as np

_HALF_WINDOW = 2  # readings on each side of the window of the median (Hampel identifier)
_MAX_DEVIATIONS = 10.0  # median deviations (about 7 standard deviations); noise stays below
_CHANGE_PERCENTILE = 95  # percentile of changes between readings; robust against one outlier in a hundred
_MAX_CHANGES = 4.0  # times the change at _CHANGE_PERCENTILE; brief true motions stay below
_MAX_QUANTA = 10.0  # quantisation steps of the rates; readings of a slow wheel that are a few ticks stay below
_MIN_RELATIVE_RATE = 1e-6  # of the 99th percentile of rates; smaller deviations are rounding errors
_MAX_ANY_RATE = 1e3  # rad/s or m/s, beyond any vehicle
_MAX_SPAN_S = 0.25  # between the neighbours of an outlier; true motion may change as much in a longer time
_MAX_OUTLIER_SHARE = 0.1  # if more readings deviate, none is taken for an outlier
_MAX_RATE_CHANGES = 2.0  # times the 95th percentile of rates: the change from forwards to backwards
_MAX_STEPS_BACK = 4  # steps within which the angle returns to its course after outliers
_MAX_REMAINDER = 0.2  # of a jump; larger sums of the steps until the return are no return
_SIZE_TOLERANCE = 0.01  # relative difference between a jump and the size of a counter
_MIN_BITS, _MAX_BITS = 8, 32  # of an encoder counter
_ANGLE_RANGES_RAD = (2.0 * np.pi, 4.0 * np.pi)  # after which joint angles wrap around
_MAX_UNAMBIGUOUS_STEP = 0.4  # of the range; a larger step may be a step in the other direction


def apart(rate: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Deviations (N, m) of rates (N, m) at seconds (N,) from the median of their neighbours, and a mask (N, m) of those
    that are outliers."""
    padded = np.pad(rate, ((_HALF_WINDOW, _HALF_WINDOW), (0, 0)), mode="reflect")
    middle = np.median(np.stack([padded[k : k + len(rate)] for k in range(2 * _HALF_WINDOW + 1)]), axis=0)
    off = rate - middle
    brisk = np.percentile(np.abs(np.diff(rate, axis=0)), _CHANGE_PERCENTILE, axis=0)
    limit = np.maximum(_MAX_DEVIATIONS * np.median(np.abs(off), axis=0), _MAX_CHANGES * brisk)
    limit = np.maximum(limit, [_coarse(r, o) for r, o in zip(rate.T, off.T, strict=True)])
    # Readings at the ends have neighbours on one side only; a higher limit keeps a sudden start.
    ends = np.isin(np.arange(len(rate)), [0, 1, len(rate) - 2, len(rate) - 1])[:, None]
    outlier = np.abs(off) > np.where(ends, np.maximum(limit, _fastest(rate)), limit)
    span = np.diff(seconds, prepend=seconds[0])
    outlier &= (span + np.append(span[1:], 0.0) < _MAX_SPAN_S)[:, None]
    if outlier.any(axis=1).sum() > _MAX_OUTLIER_SHARE * len(rate):
        outlier[:] = False
    return off, outlier


def _coarse(rate: np.ndarray, off: np.ndarray) -> float:
    """Deviation that rates (n,) of a slow wheel reach by quantisation, as of single ticks; off (n,): their
    deviations."""
    fast = min(float(np.percentile(np.abs(rate), 99)), _MAX_ANY_RATE)
    size = np.abs(off)[np.abs(off) > _MIN_RELATIVE_RATE * fast]
    return min(_MAX_QUANTA * float(np.percentile(size, 10)), 2.0 * fast) if len(size) else 0.0


def set_back(rate: np.ndarray, off: np.ndarray, outlier: np.ndarray) -> np.ndarray:
    """Mask (N, m) of the outlying steps `outlier` of angles that no motion explains: the angle was reset. Shorter ones
    are true motion and are kept. rate, off (N, m): rate of each step, and its deviation from its neighbours."""
    return outlier & (np.abs(off) > _fastest(rate))


def _fastest(rate: np.ndarray) -> np.ndarray:
    """Largest change (m,) of rates (N, m) by true motion."""
    return _MAX_RATE_CHANGES * np.percentile(np.abs(rate), _CHANGE_PERCENTILE, axis=0)


def second_order(off: np.ndarray, outlier: np.ndarray) -> np.ndarray:
    """Mask (N + 1,) of angles that are outliers: a jump leads away from the course of the angle and another one back.

    off (N, m): deviations of the N steps between the angles from neighbouring steps; outlier (N, m): those that are
    large.
    """
    wrong = np.zeros(len(off) + 1, dtype=bool)
    for column in range(off.shape[1]):
        steps = np.flatnonzero(outlier[:, column])
        for i in steps.tolist():
            if wrong[i]:
                continue
            for j in range(i + 1, min(i + _MAX_STEPS_BACK, len(off))):
                if outlier[j, column] and abs(off[i : j + 1, column].sum()) < _MAX_REMAINDER * abs(off[i, column]):
                    wrong[i + 1 : j + 1] = True
                    break
    return wrong


def counter_of(off: np.ndarray) -> int | None:
    """Size of an encoder counter, a power of two, if a jump off (n,) [ticks] has that size (wrap-around); otherwise
    None."""
    size = np.abs(off[off != 0.0])
    bits = np.round(np.log2(size))
    fits = (np.abs(size / 2.0**bits - 1.0) < _SIZE_TOLERANCE) & (bits >= _MIN_BITS) & (bits <= _MAX_BITS)
    return int(2 ** int(bits[np.argmax(fits)])) if fits.any() else None


def range_of(angles: np.ndarray) -> float | None:
    """Range [rad] after which angles (N, m) wrap around; None if they do not, or if it is ambiguous.

    All angles must lie within the range, some steps must be longer than half of it, and unwrapped steps must be short.
    """
    step = np.diff(angles, axis=0)
    for size in _ANGLE_RANGES_RAD:
        wraps = (np.abs(step) > 0.5 * size).any(axis=0)
        if not wraps.any():
            continue
        low, high = np.percentile(angles[:, wraps], [0.5, 99.5], axis=0)
        rest = np.abs(without_wraps(step[:, wraps], size))
        if (high - low < 1.001 * size).all() and np.percentile(rest, 99) < _MAX_UNAMBIGUOUS_STEP * size:
            return size
    return None


def without_wraps(step: np.ndarray, size: float) -> np.ndarray:
    """Unwrapped steps of angles or counts that wrap around after `size`: the shorter of both directions."""
    return step - size * np.round(step / size)
