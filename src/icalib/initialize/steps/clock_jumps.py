"""A clock that was set forward by seconds while it ran: it looks like a gap, but another time offset holds before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.initialize.steps.rate_correlation import SensorRates
from icalib.motion.imu_data import ImuData

MIN_CLOCK_JUMP_S = 0.5  # shorter ones are gaps that are bridged
MIN_RATES_BESIDE_JUMP = 10  # rates on either side, that tell
MAX_MATCHING_UNEXPLAINED, MIN_DIFFERENT_UNEXPLAINED = (
    0.35,
    0.7,
)  # shares of the angular rate: where two turn alike, and where they do not
UnexplainedShare = Callable[[SensorRates, float], float]


@dataclass(frozen=True)
class _ClockJump:
    """Of whose clock, if a gap is one: its size [s]; where the rates before it end and those after it begin on their
    own clock, if the time offset at hand is that of the other side; and by how much the offset grows over it."""

    whose: str
    size: float
    before: float
    after: float
    growth: float


def refuse_clock_jumps(
    imu: ImuData, name: str, rates: SensorRates, offset: float, unexplained: UnexplainedShare
) -> None:
    """Raises EstimationError where a gap is a step of the clock: one side turns as the IMU does at the `offset`, the
    other only if its clock is shifted by the gap. `unexplained`: share of the rates that is left at an offset."""
    for step in _possible_jumps(imu, name, rates, offset):
        for side, shift in ((rates.start < step.before, -step.growth), (rates.start >= step.after, step.growth)):
            own, other = _selected(rates, side), _selected(rates, ~side)
            if (
                min(len(own.start), len(other.start)) < MIN_RATES_BESIDE_JUMP
                or unexplained(own, offset) < MIN_DIFFERENT_UNEXPLAINED
            ):
                continue
            if (
                unexplained(own, offset + shift) < MAX_MATCHING_UNEXPLAINED
                and unexplained(other, offset) < MAX_MATCHING_UNEXPLAINED
            ):
                at = (step.before if shift == -step.growth else step.after) - rates.start[0]
                raise EstimationError(
                    f"the clock of {step.whose} was set forward by {step.size:.3g} s about {at:.3g} s after "
                    f"{name} began, so the time offset differs before and after; use one side with --from and "
                    "--to."
                )


def _possible_jumps(imu: ImuData, name: str, rates: SensorRates, offset: float) -> list[_ClockJump]:
    """Gaps of the IMU and of the rates that may be steps of their clocks."""
    step = float(np.median(np.diff(imu.seconds)))
    found = [_ClockJump(imu.name, b - a - step, b - offset, a - offset, b - a - step) for a, b in imu.gaps]
    size = rates.start[1:] - np.maximum.accumulate(rates.end)[:-1] - float(np.median(np.diff(rates.start)))
    for k in np.flatnonzero(size > MIN_CLOCK_JUMP_S):
        begin = float(rates.start[k + 1])
        found.append(_ClockJump(name, float(size[k]), begin, begin, -float(size[k])))
    return [x for x in found if x.size > MIN_CLOCK_JUMP_S]


def _selected(rates: SensorRates, kept: np.ndarray) -> SensorRates:
    return replace(rates, start=rates.start[kept], end=rates.end[kept], rate=rates.rate[kept])
