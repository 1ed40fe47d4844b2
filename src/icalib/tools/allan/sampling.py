"""Evenly sampled readings of an IMU, and the stretches of them at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from icalib.data.measurements import ImuStream
from icalib.data.stamps.ordered import true_runs
from icalib.errors import EstimationError

_GAP_PERIODS = 5.0  # periods: a longer interval between stamps is a gap, a shorter one is jitter of the stamps
_MOST_FILLED = 0.05  # share of missing readings: beyond it, stamps come in bursts and do not show gaps
_WINDOW_S = 1.0  # window in which the noise is computed; longer gaps are not filled
_LEAST_S = 10.0  # shortest usable length of the longest stretch at rest
_JUMP = np.repeat([0.02, 0.2], 3)  # rad/s, m/s^2: more change of the mean between windows is motion, not bias walk
_SURE = 8.0  # standard deviations of a window's mean: the same limit for noisy sensors
_OFF_RAD_S = 0.1  # a mean rate further from the median is motion; biases do not walk that far in hours
_LOUDER, _SCATTERS = 1.5, 3.0  # limit of the noise at rest: factor on the quietest, and standard deviations of its log
_QUIET = 2.0  # windows below this factor times the quietest noise give its scatter
_SHORTEST = 0.25  # of the longest stretch: shorter stretches have little information on slow noise
_GLITCH, _ALONE = 15.0, 5.0  # distance of a glitch from its neighbours' mean: over the median's, over that of near ones
_NEAR = 3  # readings on each side that are near
_SAMPLE = 200_000  # readings from which the step of rounding is found


@dataclass(frozen=True)
class Still:
    """Readings at rest. stretches: arrays (n, 6), gyroscope [rad/s] then accelerometer [m/s^2], one every `period`
    seconds; warnings: sentences."""

    stretches: tuple[np.ndarray, ...]
    period: float
    warnings: tuple[str, ...]

    @property
    def readings(self) -> np.ndarray:
        """(n, 6) readings of all stretches, concatenated."""
        return np.concatenate(self.stretches)

    @property
    def seconds(self) -> float:
        return sum(len(part) for part in self.stretches) * self.period


def still_readings(imu: ImuStream) -> Still:
    """The longest stretches of `imu` at rest, evenly sampled; warnings name readings that were filled or left out.

    Each window of a second is compared with the noise of the quietest 10 s. Raises EstimationError if the IMU was not
    at rest for 10 s.
    """
    readings, glitches = _without_glitches(np.concatenate([imu.gyro, imu.accel], axis=1), imu.name)
    parts, begins, period, gaps = _even(imu.name, imu.stamps_ns, readings)
    warnings = glitches + gaps
    window = max(1, round(_WINDOW_S / period))
    runs = [(k, *run) for k, moved in enumerate(_disturbed(parts, window)) for run in true_runs(~moved)]
    longest = max((last - first for _, first, last in runs), default=0)
    total = sum(len(part) for part in parts) * period
    if longest * window * period < _LEAST_S:
        raise EstimationError(
            f"{imu.name} was not at rest for {_LEAST_S:g} s anywhere in {total:.0f} s; put it on a table or "
            "the floor, touch nothing, and record again."
        )
    if [(k, 0, len(parts[k]) // window) for k in range(len(parts))] == runs and len(parts) == 1:
        return Still(tuple(parts), period, warnings)
    kept = [run for run in runs if run[2] - run[1] >= _SHORTEST * longest]
    named = [((last - first) * window * period, begins[k] + first * window * period) for k, first, last in kept]
    stretches = tuple(parts[k][first * window : last * window] for k, first, last in kept)
    why = "was moved or touched" if len(parts) == 1 else "was moved or touched, or has gaps of more than a second"
    return Still(stretches, period, (*warnings, f"{imu.name} {why}; {_what_is_used(total, named)}"))


def _what_is_used(total_s: float, stretches: list[tuple[float, float]]) -> str:
    """End of a warning: which part of `total_s` is used. stretches: length and begin of each [s]."""
    if len(stretches) == 1:
        long, begin = stretches[0]
        return f"only the longest stretch at rest of {total_s:.0f} s is used, {long:.0f} s from {begin:.0f} s on."
    listed = ", ".join(f"{long:.0f} s from {begin:.0f} s on" for long, begin in stretches)
    used_s = sum(long for long, _ in stretches)
    return (
        f"only the {len(stretches)} longest stretches at rest of {total_s:.0f} s are used, {used_s:.0f} s in "
        f"total: {listed}."
    )


def _without_glitches(readings: np.ndarray, name: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """`readings` (n, 6) in which glitches, single readings far off both neighbours, are replaced by the mean of these;
    and a warning with their number."""
    is_glitch = np.zeros(readings.shape, bool)
    step = _rounding_step([readings])
    for k, values in enumerate(readings.T if len(readings) >= 2 * _NEAR else ()):
        off = np.abs(values[1:-1] - 0.5 * (values[:-2] + values[2:]))
        usual = 1.4826 * float(np.median(off)) + step[k]
        padded = np.pad(off, _NEAR)  # the neighbours of a glitch, whose `off` is half of the glitch's, are not compared
        near = np.zeros(len(off))
        for j in (-3, -2, 2, 3):
            np.maximum(near, padded[_NEAR + j : len(padded) - _NEAR + j], out=near)
        step_size = np.abs(values[2:] - values[:-2])  # large if the IMU is tilted, small about a glitch
        is_glitch[1:-1, k] = off > np.maximum(_GLITCH * usual, _ALONE * np.maximum(near, step_size))
    if not is_glitch.any():
        return readings, ()
    at, axis = np.nonzero(is_glitch)
    repaired = readings.copy()
    repaired[at, axis] = 0.5 * (readings[at - 1, axis] + readings[at + 1, axis])
    return repaired, (f"{int(is_glitch.any(axis=1).sum())} readings of {name} are outliers and were removed.",)


def _even(
    name: str, stamps_ns: np.ndarray, readings: np.ndarray
) -> tuple[list[np.ndarray], list[float], float, tuple[str, ...]]:
    """Splits readings (n, 6) at gaps longer than a window, and fills shorter gaps by linear interpolation. Returns the
    parts, the begin of each since the first stamp [s], the period [s], and warnings."""
    steps = np.diff(stamps_ns) * 1e-9
    longest = max(_WINDOW_S, _GAP_PERIODS * float(np.median(steps)))
    cuts = np.flatnonzero(steps > longest) + 1
    begins = [0.0, *((stamps_ns[cuts] - stamps_ns[0]) * 1e-9).tolist()]
    joined = steps[steps <= longest]
    gap = joined > _GAP_PERIODS * np.median(steps)
    period = float(joined[~gap].mean())
    missing = np.where(gap, np.maximum(np.round(joined / period) - 1, 0), 0).astype(np.int64)
    if missing.sum() > _MOST_FILLED * len(readings):
        sentence = f"the stamps of {name} come in bursts, or with many gaps; its readings are treated as evenly spaced."
        return np.split(readings, cuts), begins, float(joined.mean()), (sentence,)
    if not missing.any():
        return np.split(readings, cuts), begins, period, ()
    parts = np.split(readings, cuts)
    missing_by_part = np.split(missing, np.cumsum([len(part) - 1 for part in parts])[:-1])
    filled = [_filled(part, count) for part, count in zip(parts, missing_by_part, strict=True)]
    sentence = (
        f"{name} has {int(gap.sum())} gaps, the longest of {joined.max():.3g} s; {int(missing.sum())} of "
        f"{sum(map(len, filled))} readings were interpolated linearly."
    )
    return filled, begins, period, (sentence,)


def _filled(readings: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """readings (n, 6) with missing (n - 1,) interpolated readings inserted after each."""
    at = np.concatenate([[0], np.cumsum(1 + missing)])
    every = np.arange(at[-1] + 1)
    return np.stack([np.interp(every, at, readings[:, k]) for k in range(6)], axis=1)


def _disturbed(parts: list[np.ndarray], window: int) -> list[np.ndarray]:
    """For each part (m,) bool: whether the IMU moved in each of its m windows, or vibrated in the window before or
    after. window: readings per window."""
    windows = [part[: len(part) // window * window].reshape(-1, window, 6) for part in parts]
    means = [w.mean(axis=1) for w in windows]
    floor = 0.5 * _rounding_step(parts)
    noises = [np.hypot(w.std(axis=1), floor) for w in windows]
    limits = _limits(windows, noises)
    if limits is None:
        return [np.ones(len(n), bool) for n in noises]
    quietest, loudest = limits
    jump = np.maximum(_JUMP, _SURE * quietest / np.sqrt(window))
    middle = np.nanmedian(np.where(np.concatenate(noises) <= loudest, np.concatenate(means), np.nan), axis=0)[:3]
    disturbed = []
    for mean, noise in zip(means, noises, strict=True):
        loud = np.pad(np.any(noise > loudest, axis=1), 1)
        loud = loud[:-2] | loud[1:-1] | loud[2:]  # the windows before and after, too
        moved = (np.abs(np.diff(mean, axis=0, prepend=mean[:1])) > jump).any(axis=1)
        disturbed.append(loud | moved | (np.abs(mean[:, :3] - middle) > _OFF_RAD_S).any(axis=1))
    return disturbed


def _limits(windows: list[np.ndarray], noises: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    """Noise (6,) of the quietest 10 s, and the largest noise (6,) of a window at rest; None if no part has 10 s.
    windows: readings (m, window, 6) of each part; noises: standard deviations (m, 6)."""
    least = round(_LEAST_S / _WINDOW_S)
    runs = [
        (np.median(sliding_window_view(noise, least, axis=0), axis=-1), readings)
        for noise, readings in zip(noises, windows, strict=True)
        if len(noise) >= least
    ]
    if not runs:
        return None
    quietest = np.min([noise.min(axis=0) for noise, _ in runs], axis=0) + 1e-12
    scatter = _scatter(np.concatenate(noises), quietest)
    for axis in range(6):
        noise, readings = min(runs, key=lambda run: run[0][:, axis].min())
        at = int(noise[:, axis].argmin())
        scatter[axis] = min(scatter[axis], _scatter_of_noise(readings[at : at + least, :, axis]))
    return quietest, quietest * _LOUDER * np.exp(_SCATTERS * scatter)


def _scatter(noises: np.ndarray, quietest: np.ndarray) -> np.ndarray:
    """(6,) standard deviation of the logarithm of the noise of quiet windows, by the median absolute deviation.
    noises (m, 6), quietest (6,)."""
    quiet = np.log(np.where(noises <= _QUIET * quietest, noises, np.nan) / quietest)
    return 1.4826 * np.nanmedian(np.abs(quiet - np.nanmedian(quiet, axis=0)), axis=0)


def _scatter_of_noise(windows: np.ndarray) -> float:
    """Standard deviation of the logarithm of the noise of windows (m, window) at rest, by Bartlett's formula from their
    spectrum. It accounts for a filter, after which few readings of a window are independent."""
    power = np.abs(np.fft.rfft(windows.ravel() - windows.mean())[1:]) ** 2
    # Sum of the squared autocorrelation.
    squares = 0.5 * len(power) * float((power**2).sum()) / max(float(power.sum()) ** 2, 1e-300)
    return float(np.sqrt(0.5 * squares / windows.shape[1]))


def _rounding_step(parts: list[np.ndarray]) -> np.ndarray:
    """(6,) median step between the distinct values of the readings: the resolution of rounded ones."""
    ends = np.cumsum([len(part) for part in parts])
    sample = np.concatenate([part[:_SAMPLE] for part in parts[: 1 + int(np.searchsorted(ends, _SAMPLE))]])
    levels = (np.unique(values) for values in sample.T)
    return np.array([np.median(np.diff(v)) if len(v) > 1 else 0.0 for v in levels])
