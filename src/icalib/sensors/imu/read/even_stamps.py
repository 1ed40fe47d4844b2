"""Sampling instants of evenly sampled readings whose stamps are late: from a FIFO, over USB or a relay, in bursts.

A stamp is the sampling instant plus a delay that is never negative. The lower envelope of the stamps over the index of
the reading is therefore the sensor's clock (minimum-delay filtering; Zhang, Liu and Xia 2002 for network clocks).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from icalib.data.stamps.clocks import usual_step

# PERIODS: in units of the sampling period. A burst is a set of readings stamped together, or a single other reading.
_UNEVEN_STEP_PERIODS = 0.2  # a step further from a whole number of periods is uneven
_MIN_UNEVEN_STEP_SHARE = 0.005  # of all steps; fewer uneven steps are single delays
_BURST_STEP_PERIODS = 0.5  # readings with shorter steps belong to one burst
_MIN_BURST_STEP_SHARE = 0.5  # of all steps are shorter than _BURST_STEP_PERIODS if the stamps come in bursts
_MIN_SAMPLES = 20  # bursts from which the period is estimated, and readings from which the roughness is
# Windows in bursts, and the quantile of the mean step over a window that is tried as the period.
_PERIOD_WINDOWS = ((20, 0.5), (5, 0.25), (1, 0.1))
_LOSS_WINDOW_BURSTS = 8  # all of these bursts in a row are late if readings were lost before them
_MIN_LOSS_PERIODS = 0.75  # a smaller increase of the least delay is no lost reading
_MAX_LOSS_SHARE = 0.05  # places with lost readings, relative to the number of readings
_ON_GRID_PERIODS, _MIN_ON_GRID_SHARE = 0.1, 0.8  # largest deviation from the even stamps; share of stamps within it
_MAX_CLOCK_STEP_PERIODS = 0.5  # change of the clock between neighbouring blocks; stamps without bursts only
_LOSS_PENALTY = 3.0  # spread of delays in periods that costs as much as a loss before every burst
_MAX_JITTER_PERIODS = 2.0  # spread of the delays of readings that do not come in bursts
_BLOCK_S, _BLOCK_BURSTS = 4.0, 40  # shortest block in which the least delay is taken; drift within a block is neglected
_MIN_DELAY_QUANTILE = 0.02  # this quantile of the delays in a block counts as zero delay
_MAX_ROUGHNESS_JITTER, _MAX_ROUGHNESS_BURSTS = 0.9, 1.1  # `_left` up to which even stamps are accepted
_MIN_WEIGHT_CHANGE = 0.1  # smaller differences of the interpolation weight do not distinguish the two sets of stamps
_MIN_SKEWNESS = 0.3  # quantile skewness of delays, above which they are one-sided

Fit = tuple[np.ndarray, float, float]  # even stamps, period, share of bursts with losses: see `_fitted`


@dataclass(frozen=True)
class EvenStamps:
    """Estimated sampling instants stamps_ns (N,) int64, at multiples of period_ns apart; burst: median size of a
    burst, 1 without bursts; latest_s: the largest delay of an original stamp [s]."""

    stamps_ns: np.ndarray
    period_ns: float
    burst: int
    latest_s: float


def even_stamps(stamps_ns: np.ndarray, values: np.ndarray) -> EvenStamps | None:
    """Even stamps for readings `values` (N, m) with uneven stamps (N,) [ns], which must not decrease.

    None if the stamps are even already, if no even stamps fit, or if the readings are not smoother at even stamps than
    at their original ones.
    """
    step = np.diff(stamps_ns).astype(np.float64)
    period = usual_step(stamps_ns)
    if len(step) < 4 * _MIN_SAMPLES or not period or _evenness(step, period) < _MIN_UNEVEN_STEP_SHARE:
        return None
    in_bursts = bool((step < _BURST_STEP_PERIODS * period).mean() > _MIN_BURST_STEP_SHARE)
    last = np.append(np.flatnonzero(step > _BURST_STEP_PERIODS * period), len(step))
    if len(last) < 2 * _MIN_SAMPLES:
        return None
    ns = (stamps_ns - stamps_ns[0]).astype(np.float64)
    limit = _MAX_ROUGHNESS_BURSTS if in_bursts else _MAX_ROUGHNESS_JITTER
    candidates = (_fitted(ns, last, first, in_bursts) for first in _periods(ns[last], last))
    fits = [
        fit
        for fit in candidates
        if fit is not None and (_is_even_but_for_some(ns - fit[0], fit) or _left(fit[0], ns, values) < limit)
    ]
    if not fits:
        return None
    even, period, _ = min(fits, key=lambda fit: _wander(ns[last] - fit[0][last]) / fit[1] + _LOSS_PENALTY * fit[2])
    if not in_bursts and _wander(ns - even) > _MAX_JITTER_PERIODS * period:
        return None
    burst = round(float(np.median(np.diff(last)))) if in_bursts else 1
    return EvenStamps(stamps_ns[0] + np.round(even).astype(np.int64), period, burst, float((ns - even).max()) * 1e-9)


def _evenness(step: np.ndarray, period: float) -> float:
    """Share of steps (N - 1,) that differ from a whole number of periods by more than _UNEVEN_STEP_PERIODS."""
    periods = np.maximum(np.round(step / period), 1.0)
    return float((np.abs(step / period - periods) > _UNEVEN_STEP_PERIODS).mean())


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


def _is_even_but_for_some(delay: np.ndarray, fit: Fit) -> bool:
    """True if no reading was lost, most delays (N,) [ns] are about zero, and all other stamps are late."""
    _, period, lost = fit
    near = _ON_GRID_PERIODS * period
    return lost == 0.0 and bool((np.abs(delay) < near).mean() > _MIN_ON_GRID_SHARE and delay.min() > -near)


def _wander(delay: np.ndarray) -> float:
    """Spread of delays: the range between their quantiles 0.05 and 0.95, in the unit of `delay`."""
    return float(np.diff(np.quantile(delay, [0.05, 0.95]))[0])


def _fitted(ns: np.ndarray, last: np.ndarray, period: float, in_bursts: bool) -> Fit | None:
    """Even stamps (N,) [ns], from the refined period and the lower envelope of the delays; gaps are left for lost
    readings. Also the refined period [ns], and the share of bursts before which readings were lost.

    ns: original stamps (N,); last: index of the last reading of each burst. None if there are too many losses, or if
    the clock changes too fast between blocks.
    """
    lost = _lost(ns[last] - period * last, period)
    losses = np.count_nonzero(np.diff(lost))
    if losses > _MAX_LOSS_SHARE * len(ns):
        return None
    number = (np.arange(len(ns)) + np.repeat(lost, np.diff(last, prepend=-1))).astype(np.float64)
    half, burst = len(last) // 2, number[last]
    period = float(np.median((ns[last][half:] - ns[last][:-half]) / (burst[half:] - burst[:-half])))
    blocks = max(round(burst[-1] * period / max(1e9 * _BLOCK_S, _BLOCK_BURSTS * burst[-1] * period / len(last))), 1)
    free = _delay_free(ns[last] - period * burst, blocks, in_bursts)
    if not in_bursts and np.abs(np.diff(free[1])).max(initial=0.0) > _MAX_CLOCK_STEP_PERIODS * period:
        return None
    return period * number + np.interp(number, *(burst[free[0]], free[1])), period, losses / len(last)


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


def _delay_free(delay: np.ndarray, blocks: int, in_bursts: bool) -> tuple[np.ndarray, np.ndarray]:
    """Index of the middle burst (b,) of each of `blocks` blocks, and the delay (b,) there that counts as zero: the
    least of one-sided delays (n,), the median of symmetric ones."""
    low, middle, high = np.quantile(delay, [0.05, 0.5, 0.95])
    one_sided = in_bursts or (high + low - 2.0 * middle) > _MIN_SKEWNESS * max(high - low, 1e-9)
    bursts = np.array_split(np.arange(len(delay)), blocks)
    values = [np.quantile(delay[x], _MIN_DELAY_QUANTILE if one_sided else 0.5) for x in bursts]
    return np.array([x[len(x) // 2] for x in bursts]), np.array(values)


def _left(even: np.ndarray, ns: np.ndarray, values: np.ndarray) -> float:
    """Roughness of the readings at even stamps, relative to that at the original stamps ns (N,); 1 if undecidable.

    Roughness: median deviation of a reading from the line between its neighbours, divided by sigma of that deviation
    for white noise. Only readings whose interpolation weights differ between the two sets of stamps are compared.
    """
    shares = [np.clip(np.diff(t)[:-1] / np.maximum(t[2:] - t[:-2], 1.0), 0.0, 1.0) for t in (even, ns)]
    other = np.abs(shares[0] - shares[1]) > _MIN_WEIGHT_CHANGE
    if other.sum() < _MIN_SAMPLES:
        return 1.0
    size = []
    for share in shares:
        a = share[other][:, None]
        line = (1.0 - a) * values[:-2][other] + a * values[2:][other]
        off = (values[1:-1][other] - line) / np.sqrt(1.0 + a**2 + (1.0 - a) ** 2)
        size.append(np.median(np.abs(off), axis=0) + 1e-300)
    return float(np.median(size[0] / size[1]))
