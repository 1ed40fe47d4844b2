"""Single wrong readings of wheels, angles that wrap, and counters that start anew."""

from __future__ import annotations

import numpy as np

_NEIGHBOURS = 2  # on each side, of whose median a reading is compared with (the Hampel identifier)
_TIMES = 10.0  # the median of all distances from it: about 6 standard deviations, which noise hardly reaches, and
_BRISK = 95  # the percentile of changes from reading to reading: one in a hundred bad readings leaves it alone
_BRISK_TIMES = 4.0  # of that change: a brisk motion may be over after one reading
_QUANTA = 10.0  # of the steps in which rates come: of a slow wheel single ticks stand apart
_NOTHING = 1e-6  # of the fastest motion
_ANY_FASTEST = 1e3  # rad/s or m/s: no vehicle's
_NEAR_S = 0.25  # from the reading before to the one after: over a longer time the motion may have been so
_MOST = 0.1  # of all readings: more are no single bad ones
_FASTEST_TIMES = 2.0  # of the fastest motion: from forwards to backwards
_BACK_WITHIN = 4  # steps: so many after a wrong reading the angle is what it was
_RETURNS = 0.2  # of a step: what is left of it where it comes back
_SAME = 0.01  # of the size of a counter
_LEAST_BITS, _MOST_BITS = 8, 32
_RANGES = (2.0 * np.pi, 4.0 * np.pi)  # of joint angles that wrap
_UNAMBIGUOUS = 0.4  # of the range: a larger step between readings may be one the other way


def apart(rate: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, m) how far rates (N, m) at seconds (N,) are from the median of their neighbours, and whether each is a single
    one that stands apart."""
    padded = np.pad(rate, ((_NEIGHBOURS, _NEIGHBOURS), (0, 0)), mode="reflect")
    middle = np.median(np.stack([padded[k : k + len(rate)] for k in range(2 * _NEIGHBOURS + 1)]), axis=0)
    off = rate - middle
    brisk = np.percentile(np.abs(np.diff(rate, axis=0)), _BRISK, axis=0)
    limit = np.maximum(_TIMES * np.median(np.abs(off), axis=0), _BRISK_TIMES * brisk)
    limit = np.maximum(limit, [_coarse(r, o) for r, o in zip(rate.T, off.T, strict=True)])
    # At the ends the neighbours of one side stand in for both: a start is not one that stands apart.
    ends = np.isin(np.arange(len(rate)), [0, 1, len(rate) - 2, len(rate) - 1])[:, None]
    own = np.abs(off) > np.where(ends, np.maximum(limit, _fastest(rate)), limit)
    span = np.diff(seconds, prepend=seconds[0])
    own &= (span + np.append(span[1:], 0.0) < _NEAR_S)[:, None]
    if own.any(axis=1).sum() > _MOST * len(rate):
        own[:] = False
    return off, own


def _coarse(rate: np.ndarray, off: np.ndarray) -> float:
    """How far rates (n,) of a slow wheel stand apart because they come in steps, as of single ticks."""
    fast = min(float(np.percentile(np.abs(rate), 99)), _ANY_FASTEST)
    size = np.abs(off)[np.abs(off) > _NOTHING * fast]
    return min(_QUANTA * float(np.percentile(size, 10)), 2.0 * fast) if len(size) else 0.0


def set_back(rate: np.ndarray, off: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(N, m) which of the steps `own` of angles are longer than any motion: the angle was set to another. Shorter ones
    are motion: what was turned is known, and stays."""
    return own & (np.abs(off) > _fastest(rate))


def _fastest(rate: np.ndarray) -> np.ndarray:
    """(m,) more than motions with rates (N, m) change."""
    return _FASTEST_TIMES * np.percentile(np.abs(rate), _BRISK, axis=0)


def second_order(off: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(N + 1,) the wrong ones of N + 1 angles whose steps (N, m) are `off` from those nearby, `own` (N, m) of them far:
    steps away from the others' path and back."""
    wrong = np.zeros(len(off) + 1, dtype=bool)
    for column in range(off.shape[1]):
        steps = np.flatnonzero(own[:, column])
        for i in steps.tolist():
            if wrong[i]:
                continue
            for j in range(i + 1, min(i + _BACK_WITHIN, len(off))):
                if own[j, column] and abs(off[i : j + 1, column].sum()) < _RETURNS * abs(off[i, column]):
                    wrong[i + 1 : j + 1] = True
                    break
    return wrong


def counter_of(off: np.ndarray) -> int | None:
    """The size of a counter that starts anew, a power of two, if steps (n,) of it are off by just that."""
    size = np.abs(off[off != 0.0])
    bits = np.round(np.log2(size))
    fits = (np.abs(size / 2.0**bits - 1.0) < _SAME) & (bits >= _LEAST_BITS) & (bits <= _MOST_BITS)
    return int(2 ** int(bits[np.argmax(fits)])) if fits.any() else None


def range_of(angles: np.ndarray) -> float | None:
    """After how many radians angles (N, m) wrap, None where they do not or where that is not clear: all lie within a
    range, some steps are longer than half of it, and without the range none is nearly as long as that."""
    step = np.diff(angles, axis=0)
    for size in _RANGES:
        wraps = (np.abs(step) > 0.5 * size).any(axis=0)
        if not wraps.any():
            continue
        low, high = np.percentile(angles[:, wraps], [0.5, 99.5], axis=0)
        rest = np.abs(without_wraps(step[:, wraps], size))
        if (high - low < 1.001 * size).all() and np.percentile(rest, 99) < _UNAMBIGUOUS * size:
            return size
    return None


def without_wraps(step: np.ndarray, size: float) -> np.ndarray:
    """Steps of angles or counts that start anew after `size`: the shorter way round."""
    return step - size * np.round(step / size)
