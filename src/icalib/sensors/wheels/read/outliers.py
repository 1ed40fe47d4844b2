"""Outliers in readings of wheels, wrap-around of angles, and of encoder counters."""

from __future__ import annotations

import numpy as np

_HALF_WINDOW = 2  # readings on each side of the window of the median (Hampel identifier)
_MAX_DEVIATIONS = 10.0  # of the median deviation, about 7 standard deviations, beyond which a reading is no noise
_CHANGE_PERCENTILE = 95  # percentile of changes between readings, which one outlier in a hundred does not influence
_MAX_CHANGES = 4.0  # of that change, beyond which a reading is no short motion
_MAX_QUANTA = 10.0  # quantisation steps of the rates, beyond which a reading of a slow wheel is not a few ticks
_MIN_RELATIVE_RATE = 1e-6  # of the largest rate: smaller deviations are rounding
_MAX_ANY_RATE = 1e3  # rad/s or m/s, beyond any vehicle
_MAX_SPAN_S = 0.25  # between the neighbours of an outlier; in a longer time the motion may change as much
_MAX_OUTLIER_SHARE = 0.1  # share of outliers; more are not single wrong readings
_MAX_RATE_CHANGES = 2.0  # of the largest rate: the change from forwards to backwards
_MAX_STEPS_BACK = 4  # steps within which the angle returns after wrong readings
_MAX_REMAINDER = 0.2  # share of a step that may be left after its return
_SIZE_TOLERANCE = 0.01  # relative, of a jump to the size of a counter
_MIN_BITS, _MAX_BITS = 8, 32
_ANGLE_RANGES_RAD = (2.0 * np.pi, 4.0 * np.pi)  # after which joint angles wrap around
_MAX_UNAMBIGUOUS_STEP = 0.4  # of the range; a larger step may be one in the other direction


def apart(rate: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, m) how far rates (N, m) at seconds (N,) are from the median of their neighbours, and whether each is a single
    one that stands apart."""
    padded = np.pad(rate, ((_HALF_WINDOW, _HALF_WINDOW), (0, 0)), mode="reflect")
    middle = np.median(np.stack([padded[k : k + len(rate)] for k in range(2 * _HALF_WINDOW + 1)]), axis=0)
    off = rate - middle
    brisk = np.percentile(np.abs(np.diff(rate, axis=0)), _CHANGE_PERCENTILE, axis=0)
    limit = np.maximum(_MAX_DEVIATIONS * np.median(np.abs(off), axis=0), _MAX_CHANGES * brisk)
    limit = np.maximum(limit, [_coarse(r, o) for r, o in zip(rate.T, off.T, strict=True)])
    # At the ends the neighbours of one side stand in for both: a start is not one that stands apart.
    ends = np.isin(np.arange(len(rate)), [0, 1, len(rate) - 2, len(rate) - 1])[:, None]
    own = np.abs(off) > np.where(ends, np.maximum(limit, _fastest(rate)), limit)
    span = np.diff(seconds, prepend=seconds[0])
    own &= (span + np.append(span[1:], 0.0) < _MAX_SPAN_S)[:, None]
    if own.any(axis=1).sum() > _MAX_OUTLIER_SHARE * len(rate):
        own[:] = False
    return off, own


def _coarse(rate: np.ndarray, off: np.ndarray) -> float:
    """How far rates (n,) of a slow wheel stand apart because they come in steps, as of single ticks."""
    fast = min(float(np.percentile(np.abs(rate), 99)), _MAX_ANY_RATE)
    size = np.abs(off)[np.abs(off) > _MIN_RELATIVE_RATE * fast]
    return min(_MAX_QUANTA * float(np.percentile(size, 10)), 2.0 * fast) if len(size) else 0.0


def set_back(rate: np.ndarray, off: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(N, m) which of the steps `own` of angles are longer than any motion: the angle was set to another. Shorter ones
    are motion: what was turned is known, and stays."""
    return own & (np.abs(off) > _fastest(rate))


def _fastest(rate: np.ndarray) -> np.ndarray:
    """(m,) more than motions with rates (N, m) change."""
    return _MAX_RATE_CHANGES * np.percentile(np.abs(rate), _CHANGE_PERCENTILE, axis=0)


def second_order(off: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(N + 1,) the wrong ones of N + 1 angles whose steps (N, m) are `off` from those nearby, `own` (N, m) of them far:
    steps away from the others' path and back."""
    wrong = np.zeros(len(off) + 1, dtype=bool)
    for column in range(off.shape[1]):
        steps = np.flatnonzero(own[:, column])
        for i in steps.tolist():
            if wrong[i]:
                continue
            for j in range(i + 1, min(i + _MAX_STEPS_BACK, len(off))):
                if own[j, column] and abs(off[i : j + 1, column].sum()) < _MAX_REMAINDER * abs(off[i, column]):
                    wrong[i + 1 : j + 1] = True
                    break
    return wrong


def counter_of(off: np.ndarray) -> int | None:
    """The size of a counter that starts anew, a power of two, if steps (n,) of it are off by just that."""
    size = np.abs(off[off != 0.0])
    bits = np.round(np.log2(size))
    fits = (np.abs(size / 2.0**bits - 1.0) < _SIZE_TOLERANCE) & (bits >= _MIN_BITS) & (bits <= _MAX_BITS)
    return int(2 ** int(bits[np.argmax(fits)])) if fits.any() else None


def range_of(angles: np.ndarray) -> float | None:
    """After how many radians angles (N, m) wrap, None where they do not or where that is not clear: all lie within a
    range, some steps are longer than half of it, and without the range none is nearly as long as that."""
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
    """Steps of angles or counts that start anew after `size`: the shorter way round."""
    return step - size * np.round(step / size)
