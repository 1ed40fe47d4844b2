"""Readings at an even rate, and the longest stretch of them that stood still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.measurements import ImuStream

_GAP_PERIODS = 5.0  # a longer step between stamps is a gap; shorter ones are jitter of whoever stamps
_MOST_FILLED = 0.05  # share of readings; beyond it stamps come in bursts, and say nothing about gaps
_WINDOW_S = 1.0
_JUMP = np.repeat([0.02, 0.2], 3)  # rad/s, m/s^2: no bias walks that far from one second to the next,
_OFF = np.repeat([0.1, 2.0], 3)  # nor that far from its median in hours
_NOISE_OFF = 5.0  # times the median noise of a window
_LEAST_S = 10.0


@dataclass(frozen=True)
class Still:
    """Readings (n, 6), gyroscope [rad/s] then accelerometer [m/s^2], one every `period` seconds."""

    readings: np.ndarray
    period: float
    warnings: tuple[str, ...]

    @property
    def seconds(self) -> float:
        return len(self.readings) * self.period


def still_readings(imu: ImuStream) -> Still:
    """The longest stretch of `imu` that stood still, at an even rate; what was filled or left out stands in warnings.

    Raises EstimationError where nothing stood still for 10 s.
    """
    readings, period, warnings = _even(imu)
    first, last = longest_run(~_disturbed(readings, period))
    window = max(1, round(_WINDOW_S / period))
    whole = len(readings) // window
    total, kept = len(readings) * period, (last - first) * window * period
    if kept < _LEAST_S:
        raise EstimationError(
            f"{imu.name} did not stand still for {_LEAST_S:g} s anywhere in {total:.0f} s; lay it on a table or the "
            "floor, touch nothing, and record again."
        )
    if last - first < whole:
        warnings += (
            f"{imu.name} was moved or touched; of {total:.0f} s the longest stretch without is used, "
            f"{kept:.0f} s from {first * window * period:.0f} s on.",
        )
        readings = readings[first * window : last * window]
    return Still(readings, period, warnings)


def _even(imu: ImuStream) -> tuple[np.ndarray, float, tuple[str, ...]]:
    """Readings with gaps filled by straight lines, and the period [s]."""
    readings = np.concatenate([imu.gyro, imu.accel], axis=1)
    steps = np.diff(imu.stamps_ns) * 1e-9
    gap = steps > _GAP_PERIODS * np.median(steps)
    period = float(steps[~gap].mean())
    missing = np.where(gap, np.maximum(np.round(steps / period) - 1, 0), 0).astype(np.int64)
    if missing.sum() > _MOST_FILLED * len(readings):
        sentence = f"the stamps of {imu.name} come in bursts, or with many gaps; its readings are taken as even."
        return readings, float(steps.mean()), (sentence,)
    if not missing.any():
        return readings, period, ()
    at = np.concatenate([[0], np.cumsum(1 + missing)])
    every = np.arange(at[-1] + 1)
    filled = np.stack([np.interp(every, at, readings[:, k]) for k in range(6)], axis=1)
    sentence = (
        f"{imu.name} has {int(gap.sum())} gaps, the longest of {steps.max():.3g} s; {int(missing.sum())} of "
        f"{len(filled)} readings are filled by straight lines."
    )
    return filled, period, (sentence,)


def _disturbed(readings: np.ndarray, period: float) -> np.ndarray:
    """(m,) whether the IMU moved in each whole window of a second."""
    window = max(1, round(_WINDOW_S / period))
    count = len(readings) // window
    if count == 0:
        return np.ones(1, dtype=bool)
    parts = readings[: count * window].reshape(count, window, 6)
    mean, noise = parts.mean(axis=1), parts.std(axis=1)
    jump = np.abs(np.diff(mean, axis=0, prepend=mean[:1]))
    moved = ((jump > _JUMP) | (np.abs(mean - np.median(mean, axis=0)) > _OFF)).any(axis=1)
    return moved | (noise > _NOISE_OFF * np.median(noise, axis=0) + 1e-12).any(axis=1)


def longest_run(flag: np.ndarray) -> tuple[int, int]:
    """Begin and end of the longest run of True in `flag` (m,)."""
    edge = np.diff(np.concatenate([[0], flag.astype(np.int8), [0]]))
    begin, end = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)
    if not len(begin):
        return 0, 0
    longest = int(np.argmax(end - begin))
    return int(begin[longest]), int(end[longest])
