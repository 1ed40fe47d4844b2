"""A clock that was set forward by seconds while it ran: it looks like a gap, but another time offset holds before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.initialize.steps.clock_shifts import CameraRates
from icalib.motion.imu_data import ImuData

LEAST_STEP_S = 0.5  # shorter ones are gaps that are bridged
FEWEST = 10  # rates on either side, that tell
EXPLAINED, UNEXPLAINED = 0.35, 0.7  # shares of the angular rate: where two turn alike, and where they do not
Left = Callable[[CameraRates, float], float]


@dataclass(frozen=True)
class _ClockStep:
    """Of whose clock, if a gap is one: its size [s]; where the rates before it end and those after it begin on their
    own clock, if the time offset at hand is that of the other side; and by how much the offset grows over it."""

    whose: str
    size: float
    before: float
    after: float
    growth: float


def refuse_steps(imu: ImuData, name: str, rates: CameraRates, offset: float, unexplained: Left) -> None:
    """Raises EstimationError where a gap is a step of the clock: one side turns as the IMU does at the `offset`, the
    other only if its clock is shifted by the gap. `unexplained`: share of the rates that is left at an offset."""
    for step in _steps(imu, name, rates, offset):
        for side, shift in ((rates.start < step.before, -step.growth), (rates.start >= step.after, step.growth)):
            own, other = _some(rates, side), _some(rates, ~side)
            if min(len(own.start), len(other.start)) < FEWEST or unexplained(own, offset) < UNEXPLAINED:
                continue
            if unexplained(own, offset + shift) < EXPLAINED and unexplained(other, offset) < EXPLAINED:
                at = (step.before if shift == -step.growth else step.after) - rates.start[0]
                raise EstimationError(
                    f"the clock of {step.whose} was set forward by {step.size:.3g} s about {at:.3g} s after "
                    f"{name} began, so the time offset differs before and after; use one side with --from and "
                    "--to."
                )


def _steps(imu: ImuData, name: str, rates: CameraRates, offset: float) -> list[_ClockStep]:
    """Gaps of the IMU and of the rates that may be steps of their clocks."""
    step = float(np.median(np.diff(imu.seconds)))
    found = [_ClockStep(imu.name, b - a - step, b - offset, a - offset, b - a - step) for a, b in imu.gaps]
    size = rates.start[1:] - np.maximum.accumulate(rates.end)[:-1] - float(np.median(np.diff(rates.start)))
    for k in np.flatnonzero(size > LEAST_STEP_S):
        begin = float(rates.start[k + 1])
        found.append(_ClockStep(name, float(size[k]), begin, begin, -float(size[k])))
    return [x for x in found if x.size > LEAST_STEP_S]


def _some(rates: CameraRates, kept: np.ndarray) -> CameraRates:
    return replace(rates, start=rates.start[kept], end=rates.end[kept], rate=rates.rate[kept])
