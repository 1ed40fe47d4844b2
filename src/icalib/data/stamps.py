"""Time stamps: order, duplicates, clock jumps, even instants of readings stamped late, time windows, units; stops."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from math import inf, isnan
from typing import Any, Protocol, TypeVar

import numpy as np

from icalib.base.remark import Remark
from icalib.errors import RecordingError
from icalib.geometry import so3
from icalib.rig import TimeUnit

# Checks of readings: finite, ordered by stamp, without duplicates.

_CUT_SHARE = 0.3  # share of readings with a conflicting stamp above which stamps are reported as truncated
_MOST_DOUBTFUL, _LEAST_LEFT = 0.1, 3  # largest tolerated share of conflicts; least readings beside a single conflict


def kept_readings(
    stamps_ns: np.ndarray, values: np.ndarray, what: str, rate_hz: tuple[float, float], noun: str, remedy: str
) -> tuple[np.ndarray, tuple[Remark, ...]]:
    """(N,) bool: readings to keep, of stamps_ns (N,) and values (N, m); and notes on the rejected ones.

    Rejected are exact repetitions, and all readings that share a stamp but differ in value. what, noun, remedy: words
    for the file, one reading, and advice on stamps. rate_hz: slowest and fastest rate. Raises RecordingError with the
    instant for NaN, unordered stamps, many conflicting readings of one stamp, or a rate outside `rate_hz`.
    """
    plural = _plural(noun)
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise RecordingError(f"{what}: the {noun} at {stamps_ns[np.argmax(bad)]} ns is not finite; remove it.")
    back = np.diff(stamps_ns) < 0
    if back.any():
        i = int(np.argmax(back))
        raise RecordingError(
            f"{what}: the {noun} at {stamps_ns[i + 1]} ns comes after the one at {stamps_ns[i]} ns; sort the {plural} "
            "by stamp, or record again if the clock was set back."
        )
    if sentence := rate_sentence(what, stamps_ns, *rate_hz):
        raise RecordingError(sentence)
    differs, again = _one_stamp(stamps_ns, values)
    _refuse_many(differs, stamps_ns, what, noun, remedy)
    notes = ()
    if differs.any():
        note = Remark(
            "readings_share_stamps",
            f"{what}: {int(differs.sum())} {plural} share a stamp with a different {noun}. Which one is right "
            f"is unknown, so all of them were removed, the first at {stamps_ns[np.argmax(differs)]} ns.",
        )
        notes += (note,)
    if again.any():
        first = stamps_ns[np.argmax(again)]
        notes += (repeated_note(what, int(again.sum()), plural, first),)
    return ~(differs | again), notes


def repeated_note(what: str, count: int, plural: str, first_ns: int) -> Remark:
    """A note on readings that repeat the one before exactly. plural: word for them; first_ns: stamp of the first."""
    return Remark("readings_repeated", f"{what}: {count} repeated {plural} were dropped, the first at {first_ns} ns.")


def _one_stamp(stamps_ns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool each: readings that share a stamp with a reading of other values, and other readings that repeat the
    stamp before. Stamps are sorted."""
    same = np.diff(stamps_ns) == 0
    group = np.concatenate([[0], np.cumsum(~same)])
    unlike = same & (np.diff(values, axis=0) != 0).any(axis=1)
    differs = np.isin(group, group[1:][unlike])
    return differs, np.concatenate([[False], same]) & ~differs


def _refuse_many(differs: np.ndarray, stamps_ns: np.ndarray, what: str, noun: str, remedy: str) -> None:
    """Raises RecordingError if too many readings, `differs` (N,) bool, share a stamp with different ones."""
    share, n_stamps = differs.mean(), len(np.unique(stamps_ns[differs]))
    if n_stamps < 2 and (~differs).sum() >= _LEAST_LEFT:
        return
    sentence = f"{what}: {int(differs.sum())} of {len(differs)} {_plural(noun)} share a stamp with a different {noun}"
    if share > _CUT_SHARE and n_stamps > 1:
        raise RecordingError(
            f"{sentence}, as if stamps were truncated to whole seconds or milliseconds; {remedy}, with all digits."
        )
    if share > _MOST_DOUBTFUL:
        raise RecordingError(f"{sentence}, the first {stamps_ns[np.argmax(differs)]} ns; {remedy}.")


def _plural(noun: str) -> str:
    return f"{noun}es" if noun.endswith("x") else f"{noun}s"


def true_runs(flag: np.ndarray) -> list[tuple[int, int]]:
    """First index, and the one after the last, of each run of True in `flag` (N,) bool."""
    edge = np.diff(np.concatenate([[0], flag.astype(np.int8), [0]]))
    return list(zip(np.flatnonzero(edge == 1).tolist(), np.flatnonzero(edge == -1).tolist(), strict=True))


def longest_run(flag: np.ndarray) -> tuple[int, int]:
    """Begin and length of the longest run of True in `flag` (N,) bool; (0, 0) if there is none."""
    begin, end = max(true_runs(flag), key=lambda run: run[1] - run[0], default=(0, 0))
    return begin, end - begin


# Forward jumps of clocks, such as when GPS or the network sets a clock during the recording.
#
# Stamps before and after a jump are valid, but hours may lie between them. The time offset of a sensor differs before
# and after the jump, so only one segment is used. No array may grow with the time that a jump spans.

JUMP_S = 600.0  # a longer step is a jump of the clock, not a pause
LONGEST_S = 6 * 3600.0  # longest calibration: memory grows with the time between first and last stamp
JUMP_STEPS = 1000.0  # a jump also exceeds this many typical steps, so that slow streams may have long pauses
_FARTHEST_NS = 2**62  # largest absolute stamp, so that differences fit in int64


class ClockJumps:
    """Cuts the streams of one recording at clock jumps, and keeps one segment of each.

    The first stream with jumps keeps its longest segment. Streams with the same number of jumps are assumed to share
    its clock, and keep the segment of the same index. notes: sentences on cuts. longest_s: largest permitted length.
    """

    def __init__(self, longest_s: float = np.inf) -> None:
        self.notes: tuple[Remark, ...] = ()
        self._longest_s = longest_s
        self._kept: dict[int, int] = {}  # which part, by how many there are

    def cut(self, stream: S, what: str) -> S:
        """The kept segment of `stream`; the stream itself if its clock does not jump. what: its name in messages.

        Raises RecordingError for stamps beyond +-2^62 ns, and for a segment longer than `longest_s`.
        """
        _refuse_far(stream.stamps_ns, what)
        cuts = _cuts(stream.stamps_ns)
        parts = list(pairwise(cuts))
        if len(parts) < 2:
            self._refuse_long(stream, what)
            return stream
        longest = int(np.argmax([_seconds(stream, *part) for part in parts]))
        kept = parts[self._kept.setdefault(len(parts), longest)]
        self.notes += (_note(stream, what, cuts, kept),)
        stream = section(stream, *kept)
        self._refuse_long(stream, what)
        return stream

    def _refuse_long(self, stream: Stamped, what: str) -> None:
        if len(stream.stamps_ns) and (length := _seconds(stream, 0, len(stream.stamps_ns))) > self._longest_s:
            raise RecordingError(
                f"{what}: the stamps span {length / 3600.0:.4g} h, and a calibration takes at most "
                f"{self._longest_s / 3600.0:g} h; choose a part with --from and --to."
            )


def longest_part(stamps_ns: np.ndarray) -> tuple[slice, int]:
    """The longest segment without jumps of stamps (N,), and the number of jumps."""
    parts = list(pairwise(_cuts(stamps_ns)))
    best = max(parts, key=lambda part: stamps_ns[part[1] - 1] - stamps_ns[part[0]] if part[1] else 0)
    return slice(*best), len(parts) - 1


def _cuts(stamps_ns: np.ndarray) -> list[int]:
    """Indices at which segments without jumps begin, followed by the number of stamps N."""
    if len(stamps_ns) < 2:
        return [0, len(stamps_ns)]
    limit_ns = max(JUMP_S * 1e9, JUMP_STEPS * usual_step(stamps_ns))
    return [0, *(np.flatnonzero(np.diff(stamps_ns) > limit_ns) + 1).tolist(), len(stamps_ns)]


def _refuse_far(stamps: np.ndarray, what: str) -> None:
    far = (stamps > _FARTHEST_NS) | (stamps < -_FARTHEST_NS)
    if far.any():
        raise RecordingError(
            f"{what}: the stamp {stamps[np.argmax(far)]} ns is more than a hundred years from 1970; correct "
            "the clock, or remove the row."
        )


def _seconds(stream: Stamped, begin: int, end: int) -> float:
    return float(stream.stamps_ns[end - 1] - stream.stamps_ns[begin]) * 1e-9


def _note(stream: Stamped, what: str, cuts: Sequence[int], kept: tuple[int, int]) -> Remark:
    stamps = stream.stamps_ns
    jump = cuts[1]
    more = f" (and {len(cuts) - 3} more times)" if len(cuts) > 3 else ""
    return Remark(
        "recording_clock_jumps",
        f"{what}: the clock jumps forward by {_seconds(stream, jump - 1, jump + 1):.6g} s{more} after the "
        f"stamp {stamps[jump - 1]} ns, {_seconds(stream, 0, jump):.6g} s from the start. Only the "
        f"{_seconds(stream, *kept):.6g} s from {stamps[kept[0]]} ns on are used; choose another part with "
        "--from and --to.",
    )


# Section of a stream: consecutive readings, images or scans.


class Stamped(Protocol):
    """A stream, checked or raw: a frozen dataclass of arrays, one of them stamps_ns (N,) int64."""

    @property
    def name(self) -> str: ...
    @property
    def stamps_ns(self) -> np.ndarray: ...


S = TypeVar("S", bound=Stamped)


def section(stream: S, begin: int, end: int) -> S:
    """The stream with stamps `begin` to before `end` of its N stamps.

    With an array `start` (N + 1,), the rows of stamp k are start[k] to start[k + 1]. Arrays of length N - 1 refer to
    the intervals between stamps.
    """
    n = len(stream.stamps_ns)
    if (begin, end) == (0, n):
        return stream
    start = getattr(stream, "start", None)
    rows = slice(begin, end) if start is None else slice(int(start[begin]), int(start[end]))
    changed: dict[str, Any] = {}
    for field in dataclasses.fields(stream):  # pyright: ignore[reportArgumentType]
        value = getattr(stream, field.name)
        if not isinstance(value, np.ndarray):
            continue
        if field.name == "stamps_ns" or (start is None and len(value) == n):
            changed[field.name] = value[begin:end]
        elif field.name == "start":
            changed[field.name] = value[begin : end + 1] - value[begin]
        elif start is None:  # (n - 1,): one for each interval between stamps
            changed[field.name] = value[begin : max(end - 1, begin)]
        else:
            changed[field.name] = value[rows]
    return dataclasses.replace(stream, **changed)  # pyright: ignore[reportArgumentType, reportCallIssue]


# Sampling instants of measurements that a device takes evenly, but that a computer stamps late: on arrival from a
# FIFO, over USB, by a relay, in bursts.
#
# A stamp is a multiple of the period plus a delay. If delays are one-sided, the lower envelope of the stamps over the
# number of the measurement is the clock of the device (minimum-delay filtering; Zhang, Liu and Xia 2002 for network
# clocks). Even stamps are accepted only if what was measured varies as at even instants, see `followed`.

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

    def note(self, what: str, noun: str) -> Remark:
        """A sentence for the user. what: the source; noun: what is stamped, in the plural."""
        how = f"come in bursts of {self.burst}" if self.burst > 1 else f"jitter by {self.jitter_s * 1e3:.2g} ms"
        return Remark(
            "stamps_jitter",
            f"{what}: the stamps {how} (up to {self.latest_s * 1e3:.3g} ms late), although the {noun} are evenly "
            f"spaced. They were made even at {1e9 / self.period_ns:.2f} Hz; let the device or its driver stamp the "
            f"{noun}.",
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


# Time window of a recording, in seconds from its start (`--from`, `--to`).

Span = tuple[int, int]  # first and last stamp, ns
_LONGEST_NS = 86_400_000_000_000  # one day: the clock of a longer stream is assumed to jump


@dataclass(frozen=True)
class Window:
    """Time window [start_s, end_s) from the start of the recording. Raises RecordingError for NaN, a negative start, or
    an end that is not after the start."""

    start_s: float = 0.0
    end_s: float = inf

    def __post_init__(self) -> None:
        if isnan(self.start_s) or not 0.0 <= self.start_s < inf:
            raise RecordingError(f"--from must be seconds after the start of the recording, not {self.start_s:g}.")
        if not self.end_s > self.start_s:
            raise RecordingError(f"--to must be seconds after --from ({self.start_s:g}), not {self.end_s:g}.")

    @property
    def is_all(self) -> bool:
        return self.start_s == 0.0 and self.end_s == inf

    def bounds(self, origin_ns: int) -> Span:
        """First stamp [ns] in the window, and first after it, for a recording that starts at origin_ns."""
        end = origin_ns + round(self.end_s * 1e9) if self.end_s < inf else 2**63 - 1
        return origin_ns + round(self.start_s * 1e9), min(end, 2**63 - 1)

    def note(self, where: str) -> Remark:
        end = f"to {self.end_s:g} s" if self.end_s < inf else "on"
        return Remark("recording_cut", f"{where}: only the part from {self.start_s:g} s after its start {end} is used.")

    def refuse(self, what: str, length_s: float) -> RecordingError:
        """The error for a window without data. length_s: length of the data from the start of the recording."""
        end = "the end" if self.end_s == inf else f"{self.end_s:g}"
        return RecordingError(
            f"{what}: there is nothing from {self.start_s:g} s to {end}, the whole lasts {length_s:.4g} s; "
            "correct --from and --to."
        )


WHOLE_RECORDING = Window()


def cut(window: Window, stream: S, what: str, spans: Sequence[Span]) -> S:
    """The section of `stream` in the window, counted from the start of the recording on its clock (`start_of`).

    what: its name in messages. spans: of all streams of the recording. Raises RecordingError if the window is empty.
    """
    if window.is_all or not len(stream.stamps_ns):
        return stream
    inside = np.flatnonzero(stamps_inside(window, stream.stamps_ns, what, spans))
    return section(stream, int(inside[0]), int(inside[-1]) + 1)


def stamps_inside(window: Window, stamps_ns: np.ndarray, what: str, spans: Sequence[Span]) -> np.ndarray:
    """(N,) bool: stamps in the window, as `cut`. Raises RecordingError if there are none."""
    span = int(stamps_ns.min()), int(stamps_ns.max())
    origin = start_of(span, spans)
    low, high = window.bounds(origin)
    inside = (stamps_ns >= low) & (stamps_ns < high)
    if not inside.any():
        raise window.refuse(what, (span[1] - origin) * 1e-9)
    return inside


def start_of(span: Span, spans: Sequence[Span]) -> int:
    """Start of the recording [ns] on the clock of a stream. span: its first and last stamp [ns]; spans: those of all
    streams.

    It is the first stamp of all streams whose spans overlap that span, directly or through other streams. A stream with
    a clock jump (longer than a day), or with another clock, starts at its first stamp.
    """
    first, last = span
    if last - first > _LONGEST_NS:
        return first
    waiting = [s for s in spans if s[1] - s[0] <= _LONGEST_NS]
    while overlapping := [s for s in waiting if s[0] <= last and s[1] >= first]:
        first, last = min(first, *(s[0] for s in overlapping)), max(last, *(s[1] for s in overlapping))
        waiting = [s for s in waiting if s not in overlapping]
    return first


# Detection of the unit of timestamps from their rate and date.

POWERS_OF_NS: dict[TimeUnit, int] = {"s": 9, "ms": 6, "us": 3, "ns": 0}
UNIT_WORDS: dict[TimeUnit, str] = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_BLOCKS = 20
_DATES_S = (9e8, 4.2e9)  # seconds since 1970, years 1998 to 2103: a number is such a date in at most one unit
_LONGEST_S = 86_400.0  # no recording is longer than a day
_USUAL_S = (2.0, 2000.0)  # usual lengths of recordings: three decades, so that only one unit gives such a length


def usual_step(stamps: np.ndarray) -> float:
    """Typical step between stamps (N,), in their unit: the median over 20 blocks of the mean step of each block.

    Bursts and jumps thus have little influence. 0 if the stamps do not increase.
    """
    edges = np.unique(np.linspace(0, len(stamps) - 1, min(_BLOCKS, len(stamps) - 1) + 1).astype(np.int64))
    step = np.diff(stamps[edges]) / np.diff(edges)
    return float(np.median(step[step > 0])) if (step > 0).any() else 0.0


def is_rate(stamps_ns: np.ndarray, slowest_hz: float, fastest_hz: float) -> bool:
    """True if stamps (N,) in ns have a typical rate within the bounds [Hz], or no rate (a single or constant stamp)."""
    step = usual_step(stamps_ns) if len(stamps_ns) > 1 else 0.0
    return step == 0.0 or slowest_hz <= 1e9 / step <= fastest_hz


def unit_of_stamps(stamps: np.ndarray, slowest_hz: float, fastest_hz: float) -> TimeUnit | None:
    """The only unit in which stamps (N,) have a typical rate within the bounds [Hz] and span at most a day.

    If there are several, the one in which stamps are dates, or else the one in which the recording has a usual length.
    None if no unit, or more than one, remains.
    """
    step, size = usual_step(stamps), float(np.median(stamps))
    every: dict[TimeUnit, float] = {unit: 10.0 ** (power - 9) for unit, power in POWERS_OF_NS.items()}
    seconds: dict[TimeUnit, float] = {u: s for u, s in every.items() if step * len(stamps) * s <= _LONGEST_S}
    possible: list[TimeUnit] = [
        u for u, s in seconds.items() if step > 0 and slowest_hz <= 1.0 / (step * s) <= fastest_hz
    ]
    dated: list[TimeUnit] = [u for u in possible if _DATES_S[0] <= size * seconds[u] <= _DATES_S[1]]
    usual: list[TimeUnit] = [u for u in possible if _USUAL_S[0] <= step * len(stamps) * seconds[u] < _USUAL_S[1]]
    return next((units[0] for units in (dated, possible, usual) if len(units) == 1), None)


def unit_by_date(numbers: Sequence[float]) -> TimeUnit | None:
    """The unit in which all `numbers` are dates from 1998 to 2103; None if there is none."""
    for unit, power in POWERS_OF_NS.items():
        if all(_DATES_S[0] <= number * 10.0 ** (power - 9) <= _DATES_S[1] for number in numbers):
            return unit
    return None


def nanoseconds(text: str, unit: TimeUnit) -> int:
    """The decimal number `text`, given in `unit`, in ns: exact arithmetic, rounded to whole ns."""
    return round(Fraction(text) * 10 ** POWERS_OF_NS[unit])


def rate_sentence(what: str, stamps_ns: np.ndarray, slowest_hz: float, fastest_hz: float) -> str | None:
    """Error message if the typical rate of stamps (N,) in ns is outside the bounds [Hz]; None if it is within them."""
    step = usual_step(stamps_ns)
    if step > 0 and slowest_hz <= 1e9 / step <= fastest_hz:
        return None
    if step == 0:
        return f"{what}: the stamps do not increase; write the time of each reading, from a running clock."
    unit = unit_of_stamps(stamps_ns, slowest_hz, fastest_hz)
    look = f"they look like {UNIT_WORDS[unit]}; export them in nanoseconds" if unit else "check what writes the stamps"
    return (
        f"{what}: the stamps give a rate of {1e9 / step:.4g} Hz ({slowest_hz:g} to {fastest_hz:g} Hz "
        f"expected); {look}, or set `time_unit` of a table in the rig file."
    )


# Detection of stop-and-go poses: a robot that stands still while each pose is recorded.

STREAM_S = 0.25  # longest step between poses of one run; longer steps are breaks
STILL = 0.2  # share of the whole motion; less within runs of poses is noise


def stands_still_between(seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> bool:
    """True if poses at seconds (n,), rotation (n, 3, 3) R_frame_body and position (n, 3), hardly move within runs.

    Breaks longer than STREAM_S separate runs. The motion within a run is the largest (`moved`) from its first pose. The
    sum over runs must be less than STILL of the whole motion, which includes that across breaks.
    """
    breaks = np.flatnonzero(np.diff(seconds) > STREAM_S)
    first, last = np.append(0, breaks + 1), np.append(breaks, len(seconds) - 1)
    run = np.repeat(first, last - first + 1)
    size = moved(rotation, position, run, np.arange(len(run)))
    within = float(np.maximum.reduceat(size, first).sum()) if len(size) else 0.0
    between = float(moved(rotation, position, last[:-1], first[1:]).sum())
    return within < STILL * (within + between)


def moved(rotation: np.ndarray, position: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) motion from poses of index a (n,) to those of index b (n,).

    It is the rotation angle [rad] plus the distance over the largest distance of all positions from their median.
    """
    turn = so3.log_many(np.ascontiguousarray(rotation[a].transpose(0, 2, 1) @ rotation[b]))
    spread = float(np.linalg.norm(position - np.median(position, axis=0), axis=1).max(initial=0.0))
    distance = np.linalg.norm(position[b] - position[a], axis=1) / max(spread, 1e-9)
    return np.linalg.norm(turn, axis=1) + distance
