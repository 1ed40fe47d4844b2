"""Removes wrong readings of an IMU and corrects their stamps; notes tell the user about both."""

from __future__ import annotations

from functools import partial

import numpy as np

from icalib.data.measurements import ImuStream
from icalib.data.stamps.even import even_stamps, followed
from icalib.sensors.imu.read.copies import copies, new_values
from icalib.sensors.imu.read.spikes import impossible, spikes, stuck

_BEYOND = 1e12  # larger readings are invalid in any unit; squares of smaller ones do not overflow
_SENSORS = ("gyroscope", "accelerometer")


def in_time(imu: ImuStream, what: str) -> tuple[ImuStream, tuple[str, ...]]:
    """Finite readings without copies, and notes. If copies were found, the other readings are sorted by stamp.

    Stamps in order that have bursts or jitter are replaced by even ones (`even_stamps`).
    """
    notes = _Notes(what, imu.stamps_ns)
    finite = np.all(np.abs(np.hstack([imu.gyro, imu.accel])) < _BEYOND, axis=1)
    notes.left_out(~finite, f"are not finite, or beyond {_BEYOND:g},")
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
        notes.left_out(again, "are delayed copies of another reading, with a later stamp,")
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
        notes.sentences += (
            f"{notes.what}: {int(again.sum())} repeated readings were dropped, the first at {first} ns.",
        )
    return _some(imu, ~again)


def without_wrong(imu: ImuStream, what: str) -> tuple[ImuStream, tuple[str, ...]]:
    """`imu` without outliers, and notes. A slower sensor whose readings the driver repeats is interpolated instead."""
    notes = _Notes(what, imu.stamps_ns)
    seconds, good = imu.seconds, np.ones(len(imu.stamps_ns), bool)
    repaired = []
    for kind, values in zip(_SENSORS, (imu.gyro, imu.accel), strict=True):
        if (new := new_values(values)) is not None:
            values = _interpolated(seconds, values, new)
            notes.sentences += (
                f"{what}: the {kind} has a new value in only {int(new.sum())} of {len(new)} readings and "
                "repeats it until the next one; the readings between were interpolated.",
            )
        bad = impossible(values, kind == "gyroscope") | stuck(values)
        rest = np.flatnonzero(~bad)
        bad[rest[spikes(seconds[rest], values[rest])]] = True
        notes.left_out(bad, f"are outliers of the {kind}, or repeat it exactly before a jump,")
        good &= ~bad
        repaired.append(values)
    if good.sum() < 2 or not notes.sentences:
        return imu, ()
    return ImuStream(imu.name, imu.stamps_ns[good], repaired[0][good], repaired[1][good]), notes.sentences


class _Notes:
    """Collects sentences for the user about readings that were left out; stamps_ns (N,): stamps of all readings."""

    def __init__(self, what: str, stamps_ns: np.ndarray) -> None:
        self.sentences: tuple[str, ...] = ()
        self.stamps_ns = stamps_ns
        self.what, self._begin_ns = what, int(stamps_ns.min()) if len(stamps_ns) else 0

    def left_out(self, bad: np.ndarray, why: str) -> None:
        if not bad.any():
            return
        first = int(self.stamps_ns[np.argmax(bad)])
        self.sentences += (
            f"{self.what}: {int(bad.sum())} of {len(bad)} readings {why} and were left out, the first "
            f"{(first - self._begin_ns) * 1e-9:.3f} s from the start, at {first} ns.",
        )


def _some(imu: ImuStream, which: np.ndarray) -> ImuStream:
    """The readings selected by `which`, a mask or indices."""
    return ImuStream(imu.name, imu.stamps_ns[which], imu.gyro[which], imu.accel[which])


def _interpolated(seconds: np.ndarray, values: np.ndarray, new: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(seconds, seconds[new], values[new, k]) for k in range(3)], axis=1)
