"""Detection of the unit of timestamps from their rate and date."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from icalib.rig import TimeUnit

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
