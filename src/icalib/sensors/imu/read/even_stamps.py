"""Stamps of readings that were sampled evenly and stamped late: from a FIFO, over USB or a relay, in bursts.

A stamp is the instant of sampling and a delay that is never negative, so the line under the stamps, over the number of
the reading, is the clock of the sensor (minimum-delay filtering; Zhang, Liu and Xia 2002 do so for network clocks).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from icalib.data.stamps.clocks import usual_step

_UNEVEN, _UNEVEN_SHARE = 0.2, 0.005  # of the period off; of the steps: fewer are single delays
_TOGETHER = 0.5  # of the period: readings with shorter steps belong to one burst
_BURSTS = 0.5  # of the steps are so short: then the stamps come in bursts
_NEAR = 20  # the fewest bursts that show a period
_WINDOWS = ((20, 0.5), (5, 0.25), (1, 0.1))  # bursts, and the quantile of their mean steps that is tried as the period
_SETTLED = 8  # bursts in a row that are late by whole periods: readings were lost before
_LOST = 0.75  # of a period
_LOST_SHARE = 0.05  # of the readings, before which others may be lost
_ON_GRID, _MOST = 0.1, 0.8  # of the period off; of the stamps
_STEADY = 0.5  # of the period, by which a clock departs from even steps within a block
_PRICE = 3.0  # periods of spread that a loss before every burst weighs as much as
_FARTHEST = 2.0  # periods over which delays of readings that do not come in bursts spread
_BLOCK_S, _BLOCK_BURSTS = 4.0, 40  # over which delays are compared: long against bursts, short against drifts
_LOW = 0.02  # quantile of delays that is none
_BETTER, _AS_GOOD = 0.9, 1.1  # times what is left with the stamps as they are
_WEIGHT = 0.1  # by which the share of a neighbour changes, where the two kinds of stamps differ
_SKEW = 0.3  # of delays (quantiles), above which they are one-sided

Fit = tuple[np.ndarray, float, float]  # see `_fitted`


@dataclass(frozen=True)
class EvenStamps:
    """stamps_ns (N,) at whole periods [ns]; burst: readings that came together, 1 for none; latest_s: the longest
    delay."""

    stamps_ns: np.ndarray
    period_ns: float
    burst: int
    latest_s: float


def even_stamps(stamps_ns: np.ndarray, values: np.ndarray) -> EvenStamps | None:
    """Stamps of the readings (N, m) at whole periods, where the stamps (N,), in order, are uneven and the readings are
    smoother at even ones. None where stamps are even, and where readings were sampled when their stamps say."""
    step = np.diff(stamps_ns).astype(np.float64)
    period = usual_step(stamps_ns)
    if len(step) < 4 * _NEAR or not period or _evenness(step, period) < _UNEVEN_SHARE:
        return None
    in_bursts = bool((step < _TOGETHER * period).mean() > _BURSTS)
    last = np.append(np.flatnonzero(step > _TOGETHER * period), len(step))
    if len(last) < 2 * _NEAR:
        return None
    ns = (stamps_ns - stamps_ns[0]).astype(np.float64)
    limit = _AS_GOOD if in_bursts else _BETTER
    tried = (_fitted(ns, last, first, in_bursts) for first in _periods(ns[last], last))
    found = [
        fit
        for fit in tried
        if fit is not None and (_is_even_but_for_some(ns - fit[0], fit) or _left(fit[0], ns, values) < limit)
    ]
    if not found:
        return None
    even, period, _ = min(found, key=lambda fit: _wander(ns[last] - fit[0][last]) / fit[1] + _PRICE * fit[2])
    if not in_bursts and _wander(ns - even) > _FARTHEST * period:
        return None
    burst = round(float(np.median(np.diff(last)))) if in_bursts else 1
    return EvenStamps(stamps_ns[0] + np.round(even).astype(np.int64), period, burst, float((ns - even).max()) * 1e-9)


def _evenness(step: np.ndarray, period: float) -> float:
    """Share of steps that are off a whole number of periods."""
    whole = np.maximum(np.round(step / period), 1.0)
    return float((np.abs(step / period - whole) > _UNEVEN).mean())


def _periods(end: np.ndarray, last: np.ndarray) -> list[float]:
    """Periods to try [ns], from stamps `end` (n,) of readings `last` (n,): over many bursts, where delays differ, and
    over few, where readings are lost in most of many."""
    tried = []
    for reach, quantile in _WINDOWS:
        slope = (end[reach:] - end[:-reach]) / (last[reach:] - last[:-reach])
        tried.append(float(np.quantile(slope, quantile)))
    return [period for period in dict.fromkeys(tried) if period > 0.0]


def _is_even_but_for_some(delay: np.ndarray, fit: Fit) -> bool:
    """Whether none was lost, nearly all stamps stand at the even ones, and the others are late."""
    _, period, lost = fit
    near = _ON_GRID * period
    return lost == 0.0 and bool((np.abs(delay) < near).mean() > _MOST and delay.min() > -near)


def _wander(delay: np.ndarray) -> float:
    """How far delays spread, but for a few."""
    return float(np.diff(np.quantile(delay, [0.05, 0.95]))[0])


def _fitted(ns: np.ndarray, last: np.ndarray, period: float, in_bursts: bool) -> Fit | None:
    """(N,) instants [ns] at whole periods, lost readings counted; the period; and the share of bursts before which some
    were lost. None where these are too many, and where no clock is so unsteady. last: index of each burst's last."""
    lost = _lost(ns[last] - period * last, period)
    losses = np.count_nonzero(np.diff(lost))
    if losses > _LOST_SHARE * len(ns):
        return None
    number = (np.arange(len(ns)) + np.repeat(lost, np.diff(last, prepend=-1))).astype(np.float64)
    half, own = len(last) // 2, number[last]
    period = float(np.median((ns[last][half:] - ns[last][:-half]) / (own[half:] - own[:-half])))
    blocks = max(round(own[-1] * period / max(1e9 * _BLOCK_S, _BLOCK_BURSTS * own[-1] * period / len(last))), 1)
    free = _delay_free(ns[last] - period * own, blocks, in_bursts)
    if not in_bursts and np.abs(np.diff(free[1])).max(initial=0.0) > _STEADY * period:
        return None
    return period * number + np.interp(number, *(own[free[0]], free[1])), period, losses / len(last)


def _lost(delay: np.ndarray, period: float) -> np.ndarray:
    """(n,) readings lost before each burst: by so many periods the least delay of bursts from there on is larger."""
    ahead = np.pad(delay, (0, _SETTLED - 1), mode="edge")
    least = np.lib.stride_tricks.sliding_window_view(ahead, _SETTLED).min(axis=1)
    lost = np.zeros(len(delay), np.int64)
    before: deque[float] = deque([float(delay[0])], maxlen=_SETTLED)
    total = 0
    for k in range(1, len(delay) - 1):
        late = float(least[k]) - total * period - min(before)
        if late > _LOST * period:
            total += round(late / period)
        lost[k] = total
        before.append(float(delay[k]) - total * period)
    lost[-1] = total
    return lost


def _delay_free(delay: np.ndarray, blocks: int, in_bursts: bool) -> tuple[np.ndarray, np.ndarray]:
    """(b,) the middle of each of `blocks` blocks of bursts, and the part of their delays (n,) that is none: the least,
    or the middle where delays are as often too short as too long."""
    low, middle, high = np.quantile(delay, [0.05, 0.5, 0.95])
    one_sided = in_bursts or (high + low - 2.0 * middle) > _SKEW * max(high - low, 1e-9)
    own = np.array_split(np.arange(len(delay)), blocks)
    values = [np.quantile(delay[x], _LOW if one_sided else 0.5) for x in own]
    return np.array([x[len(x) // 2] for x in own]), np.array(values)


def _left(even: np.ndarray, ns: np.ndarray, values: np.ndarray) -> float:
    """How far readings are off the line between their neighbours by even stamps, as a share of how far they are by the
    stamps that there are, each against the noise of such differences; where the two give the neighbours other weights.
    """
    shares = [np.clip(np.diff(t)[:-1] / np.maximum(t[2:] - t[:-2], 1.0), 0.0, 1.0) for t in (even, ns)]
    other = np.abs(shares[0] - shares[1]) > _WEIGHT
    if other.sum() < _NEAR:
        return 1.0
    size = []
    for share in shares:
        a = share[other][:, None]
        line = (1.0 - a) * values[:-2][other] + a * values[2:][other]
        off = (values[1:-1][other] - line) / np.sqrt(1.0 + a**2 + (1.0 - a) ** 2)
        size.append(np.median(np.abs(off), axis=0) + 1e-300)
    return float(np.median(size[0] / size[1]))
