"""Wrong readings of an IMU: copies, spikes, and units that gravity shows."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import combinations

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import ImuStream
from icalib.data.stamps import even_stamps, followed, repeated_note, true_runs, usual_step
from icalib.geometry import so3

# Removes wrong readings of an IMU and corrects their stamps; notes tell the user about both.

_BEYOND = 1e12  # larger readings are invalid in any unit; squares of smaller ones do not overflow
_SENSORS = ("gyroscope", "accelerometer")


def in_time(imu: ImuStream, what: str) -> tuple[ImuStream, tuple[Remark, ...]]:
    """Finite readings without copies, and notes. If copies were found, the other readings are sorted by stamp.

    Stamps in order that have bursts or jitter are replaced by even ones (`even_stamps`).
    """
    notes = _Notes(what, imu.stamps_ns)
    finite = np.all(np.abs(np.hstack([imu.gyro, imu.accel])) < _BEYOND, axis=1)
    notes.left_out(~finite, Remark("imu_readings_not_finite", f"are not finite, or beyond {_BEYOND:g},"))
    imu = _some(imu, finite)
    if len(imu.stamps_ns) < 2:
        return imu, notes.sentences
    order = np.argsort(imu.stamps_ns, kind="stable")
    ordered = _some(imu, order)
    again = copies(ordered.stamps_ns, np.hstack([ordered.gyro, ordered.accel]))
    for values in (ordered.gyro, ordered.accel):
        if not again.any() and new_values(values) is None:
            again = copies(ordered.stamps_ns, values)
    if again.any():
        notes.stamps_ns = ordered.stamps_ns
        notes.left_out(
            again, Remark("imu_readings_copied", "are delayed copies of another reading, with a later stamp,")
        )
        imu = _some(ordered, ~again)
    if (np.diff(imu.stamps_ns) >= 0).all():
        imu = _without_repeats(imu, notes)
        values, n = np.hstack([imu.gyro, imu.accel]), len(imu.stamps_ns)
        rows = {"series": np.zeros(n), "at": np.arange(n), "values": values}
        if (even := even_stamps(imu.stamps_ns, partial(followed, **rows))) is not None:
            notes.sentences += (even.note(what, "readings"),)
            imu = ImuStream(imu.name, even.stamps_ns, imu.gyro, imu.accel)
    return imu, notes.sentences


def _without_repeats(imu: ImuStream, notes: _Notes) -> ImuStream:
    """`imu` without readings that repeat the one before with the same stamp."""
    row = np.column_stack([np.diff(imu.stamps_ns), np.diff(imu.gyro, axis=0), np.diff(imu.accel, axis=0)])
    again = np.concatenate([[False], (row == 0).all(axis=1)])
    if again.any():
        first = imu.stamps_ns[np.argmax(again)]
        notes.sentences += (repeated_note(notes.what, int(again.sum()), "readings", first),)
    return _some(imu, ~again)


def without_wrong(imu: ImuStream, what: str) -> tuple[ImuStream, tuple[Remark, ...]]:
    """`imu` without outliers, and notes. A slower sensor whose readings the driver repeats is interpolated instead."""
    notes = _Notes(what, imu.stamps_ns)
    seconds, good = imu.seconds, np.ones(len(imu.stamps_ns), bool)
    repaired = []
    for kind, values in zip(_SENSORS, (imu.gyro, imu.accel), strict=True):
        if (new := new_values(values)) is not None:
            values = _interpolated(seconds, values, new)
            notes.sentences += (
                Remark(
                    "imu_sensor_slower",
                    f"{what}: the {kind} has a new value in only {int(new.sum())} of {len(new)} readings and "
                    "repeats it until the next one; the readings between were interpolated.",
                ),
            )
        bad = impossible(values, kind == "gyroscope") | stuck(values)
        rest = np.flatnonzero(~bad)
        bad[rest[spikes(seconds[rest], values[rest])]] = True
        notes.left_out(bad, Remark("imu_outliers", f"are outliers of the {kind}, or repeat it exactly before a jump,"))
        good &= ~bad
        repaired.append(values)
    if good.sum() < 2 or not notes.sentences:
        return imu, ()
    return ImuStream(imu.name, imu.stamps_ns[good], repaired[0][good], repaired[1][good]), notes.sentences


class _Notes:
    """Collects sentences for the user about readings that were left out; stamps_ns (N,): stamps of all readings."""

    def __init__(self, what: str, stamps_ns: np.ndarray) -> None:
        self.sentences: tuple[Remark, ...] = ()
        self.stamps_ns = stamps_ns
        self.what, self._begin_ns = what, int(stamps_ns.min()) if len(stamps_ns) else 0

    def left_out(self, bad: np.ndarray, why: Remark) -> None:
        if not bad.any():
            return
        first = int(self.stamps_ns[np.argmax(bad)])
        sentence = (
            f"{self.what}: {int(bad.sum())} of {len(bad)} readings {why} and were left out, the first "
            f"{(first - self._begin_ns) * 1e-9:.3f} s from the start, at {first} ns."
        )
        self.sentences += (why.with_sentence(sentence),)


def _some(imu: ImuStream, which: np.ndarray) -> ImuStream:
    """The readings selected by `which`, a mask or indices."""
    return ImuStream(imu.name, imu.stamps_ns[which], imu.gyro[which], imu.accel[which])


def _interpolated(seconds: np.ndarray, values: np.ndarray, new: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(seconds, seconds[new], values[new, k]) for k in range(3)], axis=1)


# Finds readings of an IMU that a driver sent twice with different stamps, or repeated until it had a new one.

_MAX_COPY_STEP = 0.75  # [periods]; the step from a copy to its nearest neighbour is shorter
_MAX_DELAY_NS = 1_000_000_000  # between a reading and its copy
_PERIOD_QUANTILE = 0.3  # this quantile of the steps between readings without a copy is taken as the period
_MAX_UNEVENNESS_RATIO = 0.5  # the later twins are the originals if their unevenness is below this share
_MIN_SINGLE = 20  # readings without a copy from which the period is estimated
_MIN_REPEATED_SHARE = 0.25  # of the readings are repeats if the driver repeats them
_MIN_REGULAR_SHARE = 0.9  # of the runs of equal readings have the median length, give or take one reading


def copies(stamps_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N,) bool: readings (N, m) that are exact copies of another and closer than a period to a neighbour; stamps (N,)
    [ns] must not decrease.

    All copies are assumed to be on the same side, before or after their originals. The originals are the later twins
    if these are much more evenly spaced, otherwise the earlier ones.
    """
    bad = np.zeros(len(values), bool)
    if len(values) < 2 or np.diff(stamps_ns).min() >= _MAX_COPY_STEP * usual_step(stamps_ns):
        return bad
    twins = _twins(stamps_ns, values)
    single = np.ones(len(values), bool)
    single[twins.ravel()] = False
    if not len(twins):
        return bad
    if single.sum() < _MIN_SINGLE:
        single[twins[:, 0]] = True
    known = stamps_ns[single]
    period = float(np.quantile(np.diff(known), _PERIOD_QUANTILE))
    uneven = [np.median(_uneven(known, stamps_ns[twins[:, side]], period)) for side in (0, 1)]
    twin = twins[:, 0 if uneven[1] < _MAX_UNEVENNESS_RATIO * uneven[0] else 1]
    bad[twin[_nearest(stamps_ns)[twin] < _MAX_COPY_STEP * period]] = True
    return bad


def new_values(values: np.ndarray) -> np.ndarray | None:
    """(N,) bool: readings (N, 3) that differ from the one before. None unless the driver repeats each about equally
    often until it has a new one."""
    new = np.concatenate([[True], (np.diff(values, axis=0) != 0.0).any(axis=1)])
    if (~new).mean() < _MIN_REPEATED_SHARE:
        return None
    length = np.diff(np.flatnonzero(new))
    if len(length) < 10:
        return None
    usual = float(np.median(length))
    regular = (length >= 2) & (np.abs(length - usual) <= 1.0)
    return new if regular.mean() > _MIN_REGULAR_SHARE else None


def _twins(stamps_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(n, 2) indices, the earlier first, of readings with equal values and different stamps less than _MAX_DELAY_NS
    apart. Values that occur more than twice are excluded: they come from coarse quantisation."""
    order = np.lexsort((*values.T, np.zeros(len(values))))
    same = (np.diff(values[order], axis=0) == 0.0).all(axis=1)
    same &= ~(np.append(same[1:], False) | np.insert(same[:-1], 0, False))
    pairs = np.sort(np.stack([order[:-1][same], order[1:][same]], axis=1), axis=1)
    step = stamps_ns[pairs[:, 1]] - stamps_ns[pairs[:, 0]]
    return pairs[(step > 0) & (step < _MAX_DELAY_NS)]


def _uneven(known_ns: np.ndarray, stamps_ns: np.ndarray, period: float) -> np.ndarray:
    """(n,) deviation [periods] of stamps (n,) from a whole number of periods, summed over the known stamp before and
    the one after; known_ns is sorted."""
    after = np.clip(np.searchsorted(known_ns, stamps_ns), 1, len(known_ns) - 1)
    off = [np.abs(stamps_ns - known_ns[k]) / period for k in (after - 1, after)]
    return sum((np.abs(x - np.maximum(np.round(x), 1.0)) for x in off), np.zeros(len(stamps_ns)))


def _nearest(stamps_ns: np.ndarray) -> np.ndarray:
    """(N,) step [ns] from each reading to the nearer neighbour."""
    step = np.diff(stamps_ns).astype(np.float64)
    return np.minimum(np.append(step, np.inf), np.insert(step, 0, np.inf))


# Outliers among the readings of an IMU: spikes, and values that a driver repeats instead of measuring.
#
# A reading is compared with the straight line between its neighbours, in units of the local spread of such deviations
# (Hampel's identifier). The low-pass filter of an IMU spreads a true shock over several readings, so that its
# neighbours deviate too. After a spike is removed its neighbours deviate no longer.

_MAX_DEVIATIONS = 10.0  # robust standard deviations from the line; white noise exceeds it once in 1e22 readings
_MAX_NEIGHBOUR_DEVIATIONS = 5.0  # robust standard deviations of the neighbours after the spike is removed
_HALF_WINDOW = 10  # readings to each side from which the local spread is estimated
_MAX_RUN = 3  # spikes in a row that occur by chance
_MAX_COSINE = 0.5  # cosine between the deviations of neighbours; neighbours in a shock deviate in the same direction
_MAX_OUTLIER_SHARE = 0.2  # of all readings; if more deviate, none is taken for a spike
_MAX_RELATIVE_FORCE = 100.0  # times the median norm of the accelerometer's readings; beyond any sensor's range
_MAX_RATE = 1e4  # rad/s or deg/s; beyond any gyroscope's range
_MAX_SQUARABLE = 1e150  # its square does not overflow
_MIN_REPEATS = 3  # exact repeats in a row of a sensor that is stuck
_MIN_JUMP = 8.0  # median steps around a stuck run; the first reading after the run changes by more
_MAD_TO_SIGMA = 1.4826


def spikes(seconds: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N,) bool: readings (N, 3) at seconds (N,) that are spikes."""
    bad = np.zeros(len(values), bool)
    if len(values) < 4 * _HALF_WINDOW:
        return bad
    flag = _stands_off(seconds, values, _MAX_DEVIATIONS)
    flag[1:-1] |= flag[:-2] & flag[2:]  # a reading between two opposite spikes may lie on the line
    for _ in range(2):  # a spike may hide another one near it
        good = np.flatnonzero(~bad)
        t, x = seconds[good], values[good]
        for run in true_runs(flag[good]):
            for group in _within(run, len(good)):
                if _is_wrong(t, x, group):
                    bad[good[group]] = True
                    break
    return bad


def impossible(values: np.ndarray, is_gyro: bool) -> np.ndarray:
    """(N,) bool: readings (N, 3) of a gyroscope or accelerometer that are not finite or beyond any sensor's range."""
    size = np.linalg.norm(squarable(np.where(np.isfinite(values), values, np.inf)), axis=1)
    limit = _MAX_RATE if is_gyro else _MAX_RELATIVE_FORCE * max(float(np.median(size)), 1e-9)
    return ~(size <= limit) | ~np.isfinite(values).all(axis=1)


def squarable(values: np.ndarray) -> np.ndarray:
    """`values` clipped so that their squares do not overflow; no real measurement is affected."""
    return np.clip(values, -_MAX_SQUARABLE, _MAX_SQUARABLE)


def stuck(values: np.ndarray) -> np.ndarray:
    """(N,) bool: readings (N, 3) in a run of exact repeats that ends with a jump."""
    step = np.linalg.norm(np.diff(squarable(values), axis=0), axis=1)
    bad = np.zeros(len(values), bool)
    for begin, end in true_runs(np.concatenate([[False], step == 0.0])):
        if end - begin < _MIN_REPEATS or end >= len(values):
            continue
        around = np.concatenate(
            [step[max(begin - 1 - 2 * _HALF_WINDOW, 0) : begin - 1], step[end : end + 2 * _HALF_WINDOW]]
        )
        if len(around) and step[end - 1] > _MIN_JUMP * np.median(around) > 0.0:
            bad[begin:end] = True
    return bad


def _stands_off(seconds: np.ndarray, values: np.ndarray, far: float) -> np.ndarray:
    """(N,) bool: readings that deviate from the line between their neighbours by more than `far` local standard
    deviations on some axis. All False if too many readings do."""
    off = _off_line(seconds, values)
    # Lower bound: half the spread over all readings, as the local spread of a still sensor may be small by chance.
    least = _MAD_TO_SIGMA * 0.5 * np.median(off, axis=0) + _digit(values)
    some = np.flatnonzero((off > far * least).any(axis=1))
    window = np.clip(some[:, None] + np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1), 0, len(off) - 1)
    local = _MAD_TO_SIGMA * np.median(off[window], axis=1) + _digit(values)
    flag = np.zeros(len(values), bool)
    flag[1 + some] = (off[some] > far * np.maximum(local, least)).any(axis=1)
    return flag & (flag.mean() < _MAX_OUTLIER_SHARE)


def _digit(values: np.ndarray) -> np.ndarray:
    """(3,) smallest nonzero step between readings (N, 3) on each axis: the resolution of a quantised sensor."""
    step = np.abs(np.diff(values, axis=0))
    return np.where(step > 0.0, step, np.inf).min(axis=0, initial=1e300)


def _off_line(seconds: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N - 2, 3) distances of the inner readings (N, 3) from the line between their neighbours."""
    share = ((seconds[1:-1] - seconds[:-2]) / np.maximum(seconds[2:] - seconds[:-2], 1e-12))[:, None]
    return np.abs(values[1:-1] - (1.0 - share) * values[:-2] - share * values[2:])


def _within(run: tuple[int, int], n: int) -> Iterator[np.ndarray]:
    """Candidate sets of spike indices in a run of deviating readings, to which neighbours of a spike belong as well:
    one reading, any two, or three in a row. n: number of all readings."""
    begin, end = run
    if end - begin > 2 * _MAX_RUN + 4:
        return
    one = range(max(begin, 2), min(end, n - 2))
    yield from (np.array([k]) for k in one)
    yield from (np.array(pair) for pair in combinations(one, 2))
    yield from (np.array([k, k + 1, k + 2]) for k in one[:-2])


def _is_wrong(seconds: np.ndarray, values: np.ndarray, group: np.ndarray) -> bool:
    """True if the readings with indices `group` deviate, do not look like a shock, and their neighbours fit the line
    after their removal."""
    low, high = max(group[0] - 2 * _HALF_WINDOW, 0), min(group[-1] + 2 * _HALF_WINDOW + 1, len(values))
    others = np.setdiff1d(np.arange(low, high), group, assume_unique=True)
    t, x = seconds[others], values[others]
    off = _off_line(t, x)
    scale = _MAD_TO_SIGMA * np.median(off, axis=0) + 1e-300
    away = values[group] - np.stack([np.interp(seconds[group], t, x[:, k]) for k in range(3)], axis=1)
    if not (np.abs(away) > _MAX_DEVIATIONS * scale).any(axis=1).all():
        return False
    edge = group[0] - low
    if (off[max(edge - 3, 0) : edge + 1 + group[-1] - group[0]] > _MAX_NEIGHBOUR_DEVIATIONS * scale).any():
        return False
    unit = away / np.linalg.norm(away, axis=1, keepdims=True)
    alike = (unit[1:] * unit[:-1]).sum(axis=1) > _MAX_COSINE
    return not (alike & (np.diff(group) == 1)).any()


# Gravity in the accelerometer's readings, from the IMU alone: it checks units and axes of gyroscope and accelerometer.
#
# The gyroscope rotates the specific force of a short window into axes that do not rotate. Gravity is constant there,
# and the mean of all other accelerations is small.

WINDOW_S, _RATE_HZ = 2.0, 100.0  # length of a window, and sampling rate within it
_MOST_WINDOWS = 64  # spread over the recording, from which the size of gravity is estimated


def gravity_spread(imu: ImuStream, unit: float) -> float | None:
    """RMS [m/s^2] of the specific force about its mean over two seconds, in axes that do not rotate.

    It is small if the gyroscope's readings times `unit` are the true rates [rad/s]. None for less than two seconds.
    """
    level = _level_force(imu, unit)
    if level is None:
        return None
    return float(np.sqrt(((level - level.mean(axis=1, keepdims=True)) ** 2).sum(axis=2).mean()))


def gravity_size(imu: ImuStream, unit: float) -> np.ndarray | None:
    """(n,) norm of the mean specific force over windows of two seconds, in axes that do not rotate.

    It is the size of gravity if the readings contain it and the gyroscope's readings times `unit` are the true rates
    [rad/s]. None for less than two seconds.
    """
    level = _level_force(imu, unit, _MOST_WINDOWS)
    return None if level is None else np.linalg.norm(level.mean(axis=1), axis=1)


def _level_force(imu: ImuStream, unit: float, most: int | None = None) -> np.ndarray | None:
    """Specific force (windows, n, 3) in the IMU axes of each window's first instant, for at most `most` windows.
    Windows without readings are left out. None for a recording shorter than one window."""
    t = imu.seconds
    count = int(WINDOW_S * _RATE_HZ)
    windows = np.unique((t[t < WINDOW_S * int(t[-1] / WINDOW_S)] / WINDOW_S).astype(np.int64))
    if not len(windows):
        return None
    if most is not None and len(windows) > most:
        windows = windows[np.linspace(0, len(windows) - 1, most).astype(int)]
    at = ((windows * count)[:, None] + np.arange(count)).ravel() / _RATE_HZ
    # The integral of the rates is interpolated, not the rates, so that no rotation between the instants is lost.
    angle = np.zeros((len(t), 3))
    angle[1:] = np.cumsum(0.5 * unit * (imu.gyro[1:] + imu.gyro[:-1]) * np.diff(t)[:, None], axis=0)
    turn, force = (
        np.stack([np.interp(at, t, x[:, k]) for k in range(3)], axis=1).reshape(len(windows), count, 3)
        for x in (angle, imu.accel)
    )
    R = np.tile(np.eye(3), (len(windows), 1, 1))
    level = np.empty_like(force)
    for k in range(count):
        level[:, k] = np.einsum("nij,nj->ni", R, force[:, k])
        if k + 1 < count:
            R = R @ so3.exp_many(np.ascontiguousarray(turn[:, k + 1] - turn[:, k]))
    return level
