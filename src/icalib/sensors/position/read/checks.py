"""Checks of fixes: stamps, units, motion, repeated fixes, outliers, steps."""

from __future__ import annotations

import numpy as np

from icalib.data.stamps.ordered import kept_readings, true_runs
from icalib.errors import RecordingError
from icalib.sensors.position.read.outliers import single_wrong, steps
from icalib.sensors.position.read.readings import PositionReadings
from icalib.sensors.position.read.tables import FIX_RATES_HZ
from icalib.sensors.position.stream import PositionStream

MIN_FIXES = 3  # second differences need as many
_MAX_SPEED_M_S = 350.0  # of an airliner; more is another unit
_MIN_RANGE_M = 0.05  # largest distance from the median: fixes with 1 cm of noise stay within it at rest
_MIN_FROZEN_FIXES = 4  # equal fixes in a row: receivers round, and some stand still
# A receiver is frozen if the antenna would stop or start with more than this acceleration, half of gravity, and move
# by more than this distance at once when fixes change again.
_MAX_ACCELERATION_M_S2, _MIN_LEAP_M = 5.0, 0.3


def checked_positions(read: PositionReadings, what: str) -> tuple[PositionStream, tuple[str, ...]]:
    """The fixes with strictly increasing stamps, without outliers and repeated fixes, and notes on those removed.

    Raises RecordingError naming `what` and the instant where fixes are too few, not finite, not in order, without
    motion, or in other units.
    """
    if len(read.stamps_ns) < MIN_FIXES:
        raise RecordingError(
            f"{what}: only {len(read.stamps_ns)} fixes are usable; a calibration needs the whole recording."
        )
    finite = np.asarray(np.isfinite(read.position).all(axis=1))
    notes: tuple[str, ...] = ()
    if not finite.all():
        if finite.sum() < MIN_FIXES or finite.mean() < 0.5:
            raise RecordingError(
                f"{what}: {int((~finite).sum())} of {len(finite)} positions are not finite, the first at "
                f"{read.stamps_ns[np.argmin(finite)]} ns; correct the program that writes them."
            )
        notes += (f"{what}: {int((~finite).sum())} of {len(finite)} positions are not finite and were removed.",)
        read = read.some(finite)
    remedy = "write the receiver's own stamps"
    kept, repeated = kept_readings(read.stamps_ns, read.position, what, FIX_RATES_HZ, "fix", remedy)
    read = read.some(kept)
    if len(read.stamps_ns) < MIN_FIXES:
        raise RecordingError(
            f"{what}: only {len(read.stamps_ns)} fixes are usable; a calibration needs the whole recording."
        )
    _refuse_stillness(read, what)
    _refuse_units(read, what)
    read, frozen = _without_frozen(read, what)
    read, single = _without_singles(read, what)
    notes += repeated + frozen + single + _jumps(read, what)
    return PositionStream(read.name, read.stamps_ns, np.ascontiguousarray(read.position), read.covariance), notes


def _refuse_stillness(read: PositionReadings, what: str) -> None:
    far = float(np.linalg.norm(read.position - np.median(read.position, axis=0), axis=1).max())
    if far < _MIN_RANGE_M:
        raise RecordingError(
            f"{what}: all fixes are the same within {far:.2g} m; check that the receiver was running, or record again "
            "while moving."
        )


def _refuse_units(read: PositionReadings, what: str) -> None:
    speed = float(np.median(np.linalg.norm(np.diff(read.position, axis=0), axis=1) / np.diff(read.seconds)))
    if speed > _MAX_SPEED_M_S:
        raise RecordingError(
            f"{what}: it moves at {speed:.4g} m/s, which is implausible. Positions must be in metres (divide "
            "millimetres by 1000) or degrees, and stamps in nanoseconds."
        )


def _without_frozen(read: PositionReadings, what: str) -> tuple[PositionReadings, tuple[str, ...]]:
    """The fixes without runs that a frozen receiver repeats, and a note. Before or after such a run the acceleration is
    beyond that of a vehicle. The first fix of a run stays."""
    t, p = read.seconds, read.position
    same = np.concatenate([[False], (np.diff(p, axis=0) == 0.0).all(axis=1)])
    frozen = np.zeros(len(t), dtype=bool)
    for begin, end in true_runs(same):
        if end - begin + 1 >= _MIN_FROZEN_FIXES and (_stops_hard(t, p, begin - 1) or _leaps(t, p, end - 1)):
            frozen[begin:end] = True
    if not frozen.any():
        return read, ()
    seconds = float(np.diff(t, prepend=t[0])[frozen].sum())
    note = (
        f"{what}: {int(frozen.sum())} fixes repeat the one before exactly while the antenna moves, as if the receiver "
        f"was frozen, {seconds:.1f} s in all, the first at {read.stamps_ns[np.argmax(frozen)]} ns; they were removed."
    )
    return read.some(~frozen), (note,)


def _stops_hard(t: np.ndarray, p: np.ndarray, k: int) -> bool:
    """Whether stopping at fix k, from the speed before it, takes more than _MAX_ACCELERATION_M_S2."""
    if k < 1 or k + 1 >= len(t):
        return False
    speed = np.linalg.norm(p[k] - p[k - 1]) / (t[k] - t[k - 1])
    return bool(speed > _MAX_ACCELERATION_M_S2 * (t[k + 1] - t[k]))


def _leaps(t: np.ndarray, p: np.ndarray, k: int) -> bool:
    """Whether reaching the fix after k, from rest at k, takes more than _MAX_ACCELERATION_M_S2."""
    if k + 1 >= len(t):
        return False
    step, distance = t[k + 1] - t[k], float(np.linalg.norm(p[k + 1] - p[k]))
    return distance > max(_MIN_LEAP_M, 0.5 * _MAX_ACCELERATION_M_S2 * step**2)


def _without_singles(read: PositionReadings, what: str) -> tuple[PositionReadings, tuple[str, ...]]:
    wrong = single_wrong(read.seconds, read.position)
    if not wrong.any():
        return read, ()
    return read.some(~wrong), (
        f"{what}: {int(wrong.sum())} of {len(wrong)} fixes are outliers of the trajectory and were removed, the first "
        f"at {read.stamps_ns[np.argmax(wrong)]} ns.",
    )


def _jumps(read: PositionReadings, what: str) -> tuple[str, ...]:
    """A note on steps of the solution."""
    first, vectors = steps(read.seconds, read.position)
    if not len(first):
        return ()
    size = np.linalg.norm(vectors, axis=1)
    times = "once" if len(first) == 1 else f"{len(first)} times"
    return (
        f"{what}: its fixes jump {times}, by up to {size.max():.2g} m, the first at {read.stamps_ns[first[0]]} ns, as "
        "when a receiver gains or loses its carrier-phase solution. Fixes that do not fit the trajectory are rejected; "
        "leave worse fixes out with least_status, or cut the recording with --from and --to.",
    )
