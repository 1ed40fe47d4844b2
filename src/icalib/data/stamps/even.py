"""Sampling instants of measurements that a device takes evenly, but that a computer stamps late: on arrival from a
FIFO, over USB, by a relay, in bursts.

A stamp is a multiple of the period plus a delay. If delays are one-sided, the lower envelope of the stamps over the
number of the measurement is the clock of the device (minimum-delay filtering; Zhang, Liu and Xia 2002 for network
clocks). Even stamps are accepted only if what was measured varies as at even instants, see `followed`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from icalib.data.stamps.clocks import usual_step

# PERIODS: in units of the sampling period. A burst is a set of readings stamped together, or a single other reading.
_UNEVEN_NS = 5e4  # a step further from a whole number of periods is uneven; 500 px/s are 0.03 px then
_MIN_UNEVEN_STEP_SHARE = 0.005  # of all steps; fewer uneven steps are single delays
_BURST_STEP_PERIODS = 0.5  # readings with shorter steps belong to one burst
_MIN_BURST_STEP_SHARE = 0.5  # of all steps are shorter than _BURST_STEP_PERIODS if the stamps come in bursts
_MIN_SAMPLES = 20  # bursts from which the period is estimated, and differences from which `followed` is
# Windows in bursts, and the quantile of the mean step over a window that is tried as the period.
_PERIOD_WINDOWS = ((20, 0.5), (5, 0.25), (1, 0.1))
_LOSS_WINDOW_BURSTS = 8  # all of these bursts in a row are late if readings were lost before them
_MIN_LOSS_PERIODS = 0.75  # a smaller increase of the least delay is no lost reading
_MAX_LOSS_SHARE, _MAX_BURST_LOSS_SHARE = 0.25, 0.05  # places with losses, relative to the number of readings
_ON_GRID_PERIODS, _MIN_ON_GRID_SHARE = 0.1, 0.8  # largest deviation from the even stamps; share of stamps within it
_MAX_CLOCK_STEP_PERIODS = 0.5  # change of the clock between neighbouring blocks; stamps without bursts only
_LOSS_PENALTY = 3.0  # spread of delays in periods that costs as much as a loss before every burst
_MAX_JITTER_PERIODS = 2.0  # spread of the delays of readings that do not come in bursts
_BLOCK_S, _BLOCK_BURSTS = 4.0, 40  # shortest block in which the least delay is taken; drift within a block is neglected
_MIN_WANDER = 0.7  # correlation of two halves of the measurements, in blocks: above it the clock is no line
_MIN_DELAY_QUANTILE = 0.02  # this quantile of the delays in a block counts as zero delay
_MIN_SKEWNESS = 0.3  # quantile skewness of delays, above which they are one-sided
_EVEN_SHARE, _SIGMAS = 0.5, 4.0  # even stamps are accepted, or refused, if `followed` is that far below, or above
# Weights of the neighbours 1, 2 and 3 periods away: interpolation without error up to the fifth power (sixth
# difference), and two slopes from different neighbours, so that their noise is independent.
_INTERPOLATION, _SLOPES = (0.75, -0.3, 0.05), ((0.5, 0.0, 0.0), (0.0, 0.45, -2.0 / 15.0))
_OUTLIER = 10.0  # times the median deviation: larger deviations are outliers
_OVERLAP = 1.5  # standard deviation over that of independent differences; neighbouring windows share measurements

Follows = Callable[[np.ndarray, np.ndarray], tuple[float, float]]


@dataclass(frozen=True)
class _EvenFit:
    """even (N,) [ns]: stamps at multiples of `period` [ns]; number (N,): these multiples; losses: share of bursts
    before which readings were lost; lines: number of lines of which the clock is composed."""

    even: np.ndarray
    number: np.ndarray
    period: float
    losses: float
    lines: int


@dataclass(frozen=True)
class EvenStamps:
    """Estimated sampling instants stamps_ns (N,) int64, at multiples of period_ns apart; burst: median size of a
    burst, 1 without bursts; latest_s, jitter_s: largest delay and standard deviation of the original stamps; left_s:
    that of the new ones, roughly."""

    stamps_ns: np.ndarray
    period_ns: float
    burst: int
    latest_s: float
    jitter_s: float
    left_s: float

    def note(self, what: str, noun: str) -> str:
        """A sentence for the user. what: the source; noun: what is stamped, in the plural."""
        how = f"come in bursts of {self.burst}" if self.burst > 1 else f"jitter by {self.jitter_s * 1e3:.2g} ms"
        return (
            f"{what}: the stamps {how} (up to {self.latest_s * 1e3:.3g} ms late), although the {noun} are evenly "
            f"spaced. They were made even at {1e9 / self.period_ns:.2f} Hz; let the device or its driver stamp the "
            f"{noun}."
        )


def even_stamps(stamps_ns: np.ndarray, follows: Follows) -> EvenStamps | None:
    """Even stamps for measurements with uneven stamps (N,) [ns], which must not decrease.

    follows: from the numbers (N,) and delays (N,) [periods] of a fit, how much of the delays is in the true instants,
    and its standard deviation; such as `followed`.

    None if the stamps are even already, if no even stamps fit, or if the device did not run evenly.
    """
    step = np.diff(stamps_ns).astype(np.float64)
    period = usual_step(stamps_ns)
    if len(step) < 4 * _MIN_SAMPLES or not stamp_scatter(stamps_ns):
        return None
    in_bursts = bool((step < _BURST_STEP_PERIODS * period).mean() > _MIN_BURST_STEP_SHARE)
    last = np.append(np.flatnonzero(step > _BURST_STEP_PERIODS * period), len(step))
    if len(last) < 2 * _MIN_SAMPLES:
        return None
    ns = (stamps_ns - stamps_ns[0]).astype(np.float64)
    candidates = (_fitted(ns, last, first, in_bursts) for first in _periods(ns[last], last))
    fits = [fit for fit in candidates if fit is not None and _is_accepted(fit, ns - fit.even, in_bursts, follows)]
    if not fits:
        return None
    fit = min(fits, key=lambda f: _wander(ns[last] - f.even[last]) / f.period + _LOSS_PENALTY * f.losses)
    delay = ns - fit.even
    if not in_bursts and _wander(delay) > _MAX_JITTER_PERIODS * fit.period:
        return None
    burst = round(float(np.median(np.diff(last)))) if in_bursts else 1
    even_ns = stamps_ns[0] + np.round(fit.even).astype(np.int64)
    jitter_s = 1e-9 * float(delay.std())
    left_s = jitter_s * float(np.sqrt(2.0 * fit.lines / len(last)))  # 2 parameters of a line
    return EvenStamps(even_ns, fit.period, burst, 1e-9 * float(delay.max()), jitter_s, left_s)


def stamp_scatter(stamps_ns: np.ndarray) -> float:
    """Standard deviation [s] of stamps (N,) [ns] about an even grid, from their steps; 0 if the steps are whole periods
    but for a few."""
    step = np.diff(stamps_ns).astype(np.float64)
    if not len(step):
        return 0.0
    period = float(np.median(step[step > _BURST_STEP_PERIODS * usual_step(stamps_ns)])) if step.any() else 1.0
    off = step - period * np.maximum(np.round(step / period), 1.0)
    uneven = bool((np.abs(off) > _UNEVEN_NS).mean() > _MIN_UNEVEN_STEP_SHARE)
    return 1e-9 * float(off.std()) / np.sqrt(2.0) if uneven else 0.0


def followed(
    number: np.ndarray, delay: np.ndarray, series: np.ndarray, at: np.ndarray, values: np.ndarray
) -> tuple[float, float]:
    """Share of the delays by which measurements were truly taken later, and its standard deviation: 0 if the device ran
    evenly, 1 if the stamps are true.

    number, delay (N,): see `Follows`. values (K, C): measurements; series (K,): of which series each is; at (K,): index
    of its stamp. A value deviates from the polynomial through its neighbours at even instants by its rate of change
    times what its delay exceeds theirs. The share is that regression, with one slope as the instrument of the other:
    noise in a regressor would hide a share of 1.
    """
    order = np.lexsort((at, series))
    key, at, x = series[order], at[order], values[order]
    n, d = number[at], delay[at][:, None]
    inner = slice(3, len(at) - 3)
    whole = (key[6:] == key[:-6]) & (n[6:] - n[:-6] == 6)
    if whole.sum() < _MIN_SAMPLES:
        return 0.0, np.inf
    off, late, slopes = x[inner].copy(), d[inner].copy(), np.zeros((2, len(x) - 6, x.shape[1]))
    for k, w in enumerate(_INTERPOLATION, 1):
        after, before = slice(3 + k, len(at) - 3 + k), slice(3 - k, len(at) - 3 - k)
        off -= w * (x[after] + x[before])
        late -= w * (d[after] + d[before])
        for slope, weights in zip(slopes, _SLOPES, strict=True):
            slope += weights[k - 1] * (x[after] - x[before])
    off, (a, b), stamp = off[whole], (slopes * late)[:, whole], at[inner][whole]
    size = np.median(np.abs(off), axis=0) + 1e-300
    inlier = (np.abs(off) < _OUTLIER * size) / size**2
    products = 0.5 * off * (a + b), a * b
    along, square = (np.bincount(stamp, (inlier * y).sum(axis=1), len(number)) for y in products)
    total = float(square.sum())
    if total <= 0.0:
        return 0.0, np.inf
    share = float(along.sum()) / total
    return share, _OVERLAP * float(np.sqrt(((along - share * square) ** 2).sum())) / total


def _is_accepted(fit: _EvenFit, delay: np.ndarray, in_bursts: bool, follows: Follows) -> bool:
    """Whether the device ran evenly. Where measurements cannot show it, late stamps are accepted, and jitter is not.
    delay (N,) [ns]: of the original stamps."""
    if np.abs(delay).max() < _UNEVEN_NS:
        return False
    share, sigma = follows(fit.number, delay / fit.period)
    if in_bursts or _is_even_but_for_some(delay, fit):
        return share - _SIGMAS * sigma < _EVEN_SHARE
    return share + _SIGMAS * sigma < _EVEN_SHARE


def _periods(end: np.ndarray, last: np.ndarray) -> list[float]:
    """Periods to try [ns], from stamps `end` (n,) [ns] of readings with the indices `last` (n,), the last of each
    burst.

    Long windows average varying delays; short windows still contain some bursts without a loss if losses are frequent.
    """
    tried = []
    for reach, quantile in _PERIOD_WINDOWS:
        slope = (end[reach:] - end[:-reach]) / (last[reach:] - last[:-reach])
        tried.append(float(np.quantile(slope, quantile)))
    return [period for period in dict.fromkeys(tried) if period > 0.0]


def _is_even_but_for_some(delay: np.ndarray, fit: _EvenFit) -> bool:
    """True if no reading was lost, most delays (N,) [ns] are about zero, and all other stamps are late."""
    near = _ON_GRID_PERIODS * fit.period
    return fit.losses == 0.0 and bool((np.abs(delay) < near).mean() > _MIN_ON_GRID_SHARE and delay.min() > -near)


def _wander(delay: np.ndarray) -> float:
    """Spread of delays: the range between their quantiles 0.05 and 0.95, in the unit of `delay`."""
    return float(np.diff(np.quantile(delay, [0.05, 0.95]))[0])


def _fitted(ns: np.ndarray, last: np.ndarray, period: float, in_bursts: bool) -> _EvenFit | None:
    """Even stamps, from the refined period and the lower envelope of the delays; gaps are left for lost readings.

    ns: original stamps (N,); last: index of the last reading of each burst. None if there are too many losses, or if
    the clock changes too fast between blocks.
    """
    lost = _lost(ns[last] - period * last, period)
    losses = np.count_nonzero(np.diff(lost))
    if losses > (_MAX_BURST_LOSS_SHARE if in_bursts else _MAX_LOSS_SHARE) * len(ns):
        return None
    number = (np.arange(len(ns)) + np.repeat(lost, np.diff(last, prepend=-1))).astype(np.float64)
    half, burst = len(last) // 2, number[last]
    period = float(np.median((ns[last][half:] - ns[last][:-half]) / (burst[half:] - burst[:-half])))
    blocks = max(round(burst[-1] * period / max(1e9 * _BLOCK_S, _BLOCK_BURSTS * burst[-1] * period / len(last))), 1)
    delay = ns[last] - period * burst
    parts = np.array_split(np.arange(len(last)), blocks)
    one_sided = in_bursts or _is_one_sided(delay)
    free = _delay_free(delay, parts, _MIN_DELAY_QUANTILE if one_sided else 0.5)
    if not in_bursts and np.abs(np.diff(free[0])).max(initial=0.0) > _MAX_CLOCK_STEP_PERIODS * period:
        return None
    at = np.array([burst[part[len(part) // 2]] for part in parts])
    wanders = _wanders(at, free)
    if wanders:
        clock = np.interp(number, at, free[0])
    else:
        clock = (_line(at, free[0]) if one_sided else _line(burst, delay))(number)
    return _EvenFit(period * number + clock, number, period, losses / len(last), blocks if wanders else 1)


def _wanders(at: np.ndarray, free: np.ndarray) -> bool:
    """True if the delays of b blocks, at the numbers at (b,), that count as zero deviate from a line, and do so alike
    in both halves of the measurements. free (3, b): delays of all measurements and of each half."""
    if len(at) < 4:
        return False
    _, a, b = (x - _line(at, x)(at) for x in free)
    return bool(a @ b > _MIN_WANDER * np.linalg.norm(a) * np.linalg.norm(b))


def _line(x: np.ndarray, y: np.ndarray) -> np.polynomial.Polynomial:
    """The line through y (n,) over x (n,), without outliers; a constant for less than two."""
    off = np.abs(y - np.median(y))
    good = off <= _OUTLIER * np.median(off)
    return np.polynomial.Polynomial.fit(x[good], y[good], min(int(good.sum()) - 1, 1))


def _lost(delay: np.ndarray, period: float) -> np.ndarray:
    """(n,) cumulative number of readings lost before each burst, from its delay (n,) [ns] without losses.

    A loss raises the least delay of all later bursts by whole periods; a late burst raises only its own delay.
    """
    ahead = np.pad(delay, (0, _LOSS_WINDOW_BURSTS - 1), mode="edge")
    least = np.lib.stride_tricks.sliding_window_view(ahead, _LOSS_WINDOW_BURSTS).min(axis=1)
    lost = np.zeros(len(delay), np.int64)
    before: deque[float] = deque([float(delay[0])], maxlen=_LOSS_WINDOW_BURSTS)
    total = 0
    for k in range(1, len(delay) - 1):
        late = float(least[k]) - total * period - min(before)
        if late > _MIN_LOSS_PERIODS * period:
            total += round(late / period)
        lost[k] = total
        before.append(float(delay[k]) - total * period)
    lost[-1] = total
    return lost


def _is_one_sided(delay: np.ndarray) -> bool:
    low, middle, high = np.quantile(delay, [0.05, 0.5, 0.95])
    return bool(high + low - 2.0 * middle > _MIN_SKEWNESS * max(high - low, 1e-9))


def _delay_free(delay: np.ndarray, parts: Sequence[np.ndarray], quantile: float) -> np.ndarray:
    """(3, b) `quantile` of the delays (n,) in each of b blocks, of all measurements and of each half of them; parts:
    indices of the blocks."""
    halves = (slice(None), slice(0, None, 2), slice(1, None, 2))
    return np.array([[np.quantile(delay[part[half]], quantile) for part in parts] for half in halves])
