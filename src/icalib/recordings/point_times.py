"""When the points of a cloud were measured, from what drivers write beside their coordinates.

The field is called `time`, `t`, `timestamp`, `time_stamp` or `offset_time`. Its values are

- relative: seconds where it is a floating-point number, nanoseconds where it is a whole one, from the stamp of the
  message on (Velodyne's `time`, below zero where the last point is stamped; Ouster's `t`, Livox's `offset_time`);
- or absolute, going on from scan to scan: s, ms, us or ns of a clock (`timestamp` of Hesai and RoboSense in s, of
  Livox in ns). Then this clock, not that of the messages' stamps, is the LiDAR's.

`point_time` of the rig file says otherwise. start, end: the message is stamped when its first, its last point was
measured. azimuth: there are no times, and the LiDAR turns at a constant rate, once in a scan. snapshot: all points were
measured at the stamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor

import numpy as np

from icalib.errors import RecordingError
from icalib.recordings.lidar_checks import span_sentence
from icalib.rig import PointTime

FIELDS = ("offset_time", "time", "t", "timestamp", "time_stamp")
_UNITS_NS = (1, 1_000, 1_000_000, 1_000_000_000)
_UNIT_FIT = 1.5  # how far the unit of absolute times may be off what the stamps say
_CHOICES = "set point_time to azimuth (it turns) or snapshot (all points at the stamp) in the rig file"


@dataclass(frozen=True)
class PointTimes:
    """How the times in `field` are read: nanoseconds in one unit, whether they are absolute, and what the message's
    stamp means."""

    field: str
    unit_ns: int
    absolute: bool
    point_time: PointTime

    def of(self, stamp_ns: int, values: np.ndarray) -> tuple[int, np.ndarray]:
        """The stamp of a scan and seconds (N,) float32 from it to each point, NaN where it has no time. stamp_ns: of
        the message; values (N,): of the field."""
        times = values.astype(np.float64)
        timed = _timed(times, self.absolute)
        if not timed.any():
            return stamp_ns, np.full(len(times), np.nan, np.float32)
        first, last = float(times[timed].min()), float(times[timed].max())
        # Differences first: float64 nanoseconds since 1970 step by 256.
        since_first = (times - first) * (self.unit_ns * 1e-9)
        if self.point_time == "end":
            since_first -= (last - first) * (self.unit_ns * 1e-9)
        elif self.point_time == "auto" and self.absolute:
            stamp_ns = floor(first) * self.unit_ns + round((first - floor(first)) * self.unit_ns)
        elif self.point_time == "auto":
            since_first += first * (self.unit_ns * 1e-9)
        since_first[~timed] = np.nan
        return stamp_ns, since_first.astype(np.float32)


def find_point_times(
    what: str, stamps_ns: np.ndarray, scans: Sequence[np.ndarray], point_time: PointTime
) -> PointTimes:
    """How the points of some scans, structured arrays of messages stamped stamps_ns (S,), are timed.

    Raises RecordingError naming `what`: no field with times, or one that says nothing, or is in another unit.
    """
    names = scans[0].dtype.names or ()
    field = next((f for f in FIELDS if f in names and scans[0][f].ndim == 1), None)
    if field is None:
        raise RecordingError(
            f"{what}: the points have no times (their fields are {', '.join(names)}); record a cloud that has them, or "
            f"{_CHOICES}."
        )
    times = [scan[field].astype(np.float64) for scan in scans]
    used = [t[_timed(t, True)] for t in times if _timed(t, True).any()]
    firsts, lasts = np.array([t.min() for t in used]), np.array([t.max() for t in used])
    if not (lasts > firsts).any():
        raise RecordingError(
            f"{what}: all points of a scan have the same `{field}`; correct the driver, or {_CHOICES}."
        )
    period_s = float(np.median(np.diff(stamps_ns))) * 1e-9
    if len(used) > 1 and np.median(np.diff(lasts)) > 0.5 * np.median(lasts - firsts):
        return PointTimes(field, _unit_of_clock(what, field, lasts, period_s), True, point_time)
    unit, unit_ns = ("ns", 1) if scans[0].dtype[field].kind in "iu" else ("s", 1_000_000_000)
    span_s = float((lasts - firsts).max()) * unit_ns * 1e-9
    sentence = span_sentence(f"{what}: the times `{field}`, read as {unit},", span_s, period_s)
    if sentence:
        raise RecordingError(sentence)
    return PointTimes(field, unit_ns, False, point_time)


def clock_note(what: str, times: PointTimes, stamp_ns: int, first_ns: int) -> str | None:
    """A sentence where points are timed on another clock than that of the messages' stamps: one was stamped stamp_ns,
    its first point first_ns."""
    if not times.absolute or times.point_time != "auto" or abs(first_ns - stamp_ns) < 1_000_000_000:
        return None
    return (
        f"{what}: the points' `{times.field}` is on another clock than the messages' stamps, "
        f"{(stamp_ns - first_ns) * 1e-9:.3f} s behind; the points' clock is used, and time_offset is from it."
    )


def _timed(times: np.ndarray, absolute: bool) -> np.ndarray:
    """(N,) bool: which points have a time; drivers write 0 where no light came back."""
    return np.isfinite(times) & ((times != 0) | (not absolute))


def _unit_of_clock(what: str, field: str, lasts: np.ndarray, period_s: float) -> int:
    """Nanoseconds in a unit of absolute times, from how far scans are apart."""
    step = float(np.median(np.diff(lasts)))
    for unit_ns in _UNITS_NS:
        if 1.0 / _UNIT_FIT < step * unit_ns * 1e-9 / period_s < _UNIT_FIT:
            return unit_ns
    raise RecordingError(
        f"{what}: `{field}` goes on by {step:.4g} from scan to scan, which is {period_s:.4g} s in no unit (s, ms, us, "
        "ns); correct the driver, or set point_time in the rig file."
    )
