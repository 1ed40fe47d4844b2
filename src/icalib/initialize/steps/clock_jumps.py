"""Refuses recordings in which a clock was set forward by seconds. Such a jump looks like a gap, but the time offset
differs before and after it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.initialize.steps.rate_correlation import SensorRates
from icalib.motion.imu_data import ImuData

MIN_CLOCK_JUMP_S = 0.5  # s: shorter gaps are bridged by interpolation
MIN_RATES_BESIDE_JUMP = 10  # rates on a side of the gap: with fewer the unexplained share is mostly noise
MAX_MATCHING_UNEXPLAINED = 0.35  # largest unexplained share of the angular rate at which both sensors turn alike
MIN_DIFFERENT_UNEXPLAINED = 0.7  # smallest unexplained share at which they do not
UnexplainedShare = Callable[[SensorRates, float], float]


@dataclass(frozen=True)
class _ClockJump:
    """A gap that may be a jump of the clock of the sensor `whose`. size: length of the gap [s]; growth: change of the
    time offset [s].

    before: time of the jump [s, clock of the rates] if the present offset holds after it; after: the same if the
    present offset holds before it.
    """

    whose: str
    size: float
    before: float
    after: float
    growth: float


def refuse_clock_jumps(
    imu: ImuData, name: str, rates: SensorRates, offset: float, unexplained: UnexplainedShare
) -> None:
    """Raises EstimationError if a gap is a jump of a clock. On one side of such a gap both sensors turn alike at the
    `offset` [s], on the other side only at an offset that differs by the length of the gap.

    unexplained(rates, offset): share of the angular rate that the IMU does not explain, from 0 to 1.
    """
    for jump in _possible_jumps(imu, name, rates, offset):
        for side, shift in ((rates.start < jump.before, -jump.growth), (rates.start >= jump.after, jump.growth)):
            one_side, other_side = _selected(rates, side), _selected(rates, ~side)
            if (
                min(len(one_side.start), len(other_side.start)) < MIN_RATES_BESIDE_JUMP
                or unexplained(one_side, offset) < MIN_DIFFERENT_UNEXPLAINED
            ):
                continue
            if (
                unexplained(one_side, offset + shift) < MAX_MATCHING_UNEXPLAINED
                and unexplained(other_side, offset) < MAX_MATCHING_UNEXPLAINED
            ):
                at = (jump.before if shift == -jump.growth else jump.after) - rates.start[0]
                raise EstimationError(
                    f"the clock of {jump.whose} was set forward by {jump.size:.3g} s about {at:.3g} s after "
                    f"{name} began, so the time offset differs before and after; use one side with --from and "
                    "--to."
                )


def _possible_jumps(imu: ImuData, name: str, rates: SensorRates, offset: float) -> list[_ClockJump]:
    """Gaps of the IMU's readings and of the rates that are longer than MIN_CLOCK_JUMP_S. offset [s]: time of the IMU
    minus time of the rates."""
    step = float(np.median(np.diff(imu.seconds)))
    # A jump of the IMU's clock adds to the time offset, one of the other clock reduces it.
    jumps = [_ClockJump(imu.name, b - a - step, b - offset, a - offset, b - a - step) for a, b in imu.gaps]
    size = rates.start[1:] - np.maximum.accumulate(rates.end)[:-1] - float(np.median(np.diff(rates.start)))
    for k in np.flatnonzero(size > MIN_CLOCK_JUMP_S):
        begin = float(rates.start[k + 1])
        jumps.append(_ClockJump(name, float(size[k]), begin, begin, -float(size[k])))
    return [x for x in jumps if x.size > MIN_CLOCK_JUMP_S]


def _selected(rates: SensorRates, kept: np.ndarray) -> SensorRates:
    """The rates where `kept` (n,) is true."""
    return replace(rates, start=rates.start[kept], end=rates.end[kept], rate=rates.rate[kept])
