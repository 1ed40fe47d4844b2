"""Times of the points of a cloud, from a field that drivers write in addition to the coordinates.

The field is one of FIELDS, or `point_time_field` of the rig file. Its values are

- relative to the stamp of the message: in seconds for floating-point numbers; in nanoseconds for integers, or if the
  name ends in _ns (Velodyne's `time`, negative if the stamp is that of the last point; Ouster's `t`, Livox's
  `offset_time`, Aeva's `time_offset_ns`, Blickfeld's `point_time_offset`);
- or absolute, increasing from scan to scan: s, ms, us or ns of a clock (`timestamp` of Hesai and RoboSense in s, of
  Livox in ns). This clock is then the LiDAR's clock instead of that of the message stamps.

The unit is checked by the duration of scans, which is 0.02 to 1.7 scan periods; at most one unit fits.

`point_time` of the rig file overrides this. start, end: the message is stamped when its first or its last point was
measured. azimuth: no times are recorded, and the LiDAR turns at a constant rate, once per scan. snapshot: all points
were measured at the stamp.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import floor

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import LidarStream
from icalib.data.stamps import even_stamps
from icalib.errors import RecordingError
from icalib.rig import Lidar, PointTime, TimeUnit

FIELDS = (
    "offset_time",
    "time",
    "t",
    "timestamp",
    "time_stamp",
    "time_offset_ns",
    "point_time_offset",
    "time_offset",
    "ts",
    "stamps",
)
UNIT_NS: dict[TimeUnit, int] = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
MAX_SCAN_PERIODS = 1.7  # longest scan, in scan periods: scans may overlap
_MIN_SCAN_PERIODS = 0.02  # shortest scan, a narrow sector of a turn; shorter ones have another unit, or are flashes
_MAX_PERIOD_RATIO = 1.5  # largest ratio between the scan periods by point times and by stamps
_MAX_TIME = 1e25  # larger values are no times; ns since 1970 are about 1e18
_BULK_PERCENT = (5.0, 95.0)  # percentiles of the times of a scan, robust against outliers
_LIKE_A_TIME = re.compile(r"time|stamp|offset|curvature|(^|_)(t|ts|dt|s|ms|us|ns|[mun]?secs?)\d*(_|$)", re.IGNORECASE)
_NO_TIMES = {"x", "y", "z", "intensity", "reflectivity", "ring", "line", "tag", "range", "rgb", "rgba"}
_POINT_TIME_CHOICES = "set point_time to azimuth (it turns) or snapshot (all points at the stamp) in the rig file"


@dataclass(frozen=True)
class PointTimes:
    """Interpretation of the times in `field`: their unit; absolute or relative to the stamp; point_time: meaning of the
    stamp of a message. longest_s: largest duration of a scan [s]."""

    field: str
    unit: TimeUnit
    absolute: bool
    point_time: PointTime
    longest_s: float

    def of(self, stamp_ns: int, values: np.ndarray) -> tuple[int, np.ndarray]:
        """Stamp [ns] of a scan, and time (N,) float32 [s] of each point since it; NaN for points without a time, or
        with an outlying one. stamp_ns: stamp of the message; values (N,): values of the field."""
        unit_ns = UNIT_NS[self.unit]
        times = _decimal(values)
        timed = _timed(times, self.absolute)
        timed[timed] = within_scan(times[timed], self.longest_s * 1e9 / unit_ns)
        if not timed.any():
            return stamp_ns, np.full(len(times), np.nan, np.float32)
        first, last = float(times[timed].min()), float(times[timed].max())
        times[~timed] = np.nan
        # Differences first: the resolution of float64 nanoseconds since 1970 is 256 ns.
        since_first = (times - first) * (unit_ns * 1e-9)
        if self.point_time == "end":
            since_first -= (last - first) * (unit_ns * 1e-9)
        elif self.point_time == "auto" and self.absolute:
            stamp_ns = floor(first) * unit_ns + round((first - floor(first)) * unit_ns)
        elif self.point_time == "auto":
            since_first += first * (unit_ns * 1e-9)
        return stamp_ns, since_first.astype(np.float32)


def within_scan(times: np.ndarray, longest: float) -> np.ndarray:
    """(N,) bool: the time is no outlier. times (N,): finite times of a scan; longest: its largest duration, in the same
    unit."""
    if not len(times) or times.max() - times.min() <= longest:
        return np.ones(len(times), bool)
    near = times[np.abs(times - np.median(times)) <= longest]
    low, high = np.percentile(near, _BULK_PERCENT) if len(near) else (np.inf, -np.inf)
    return (times >= high - longest) & (times <= low + longest)


def find_point_times(
    what: str, stamps_ns: np.ndarray, scans: Sequence[np.ndarray], lidar: Lidar
) -> tuple[PointTimes, tuple[Remark, ...]]:
    """Interpretation of point times, found from some scans: structured arrays of messages with stamps_ns (S,). Also a
    note if their unit is not the usual one of drivers.

    Raises RecordingError naming `what` if there is no field of times, if its values are constant, or if no unit fits.
    """
    field = _field(what, scans, lidar)
    times = [_decimal(scan[field]) for scan in scans]
    used = [t[_timed(t, True)] for t in times if _timed(t, True).any()]
    period_s = float(np.median(np.diff(stamps_ns))) * 1e-9
    if (ends := _clock_instants(used, period_s)) is not None:
        unit = _unit_of_clock(what, field, ends, period_s, lidar)
        return PointTimes(field, unit, True, lidar.point_time, MAX_SCAN_PERIODS * period_s), ()
    usual = _usual_unit(field, scans[0].dtype[field].kind in "iu")
    unit, notes = unit_of_offsets(f"{what}: the times `{field}`", used, period_s, lidar, usual)
    return PointTimes(field, unit, False, lidar.point_time, MAX_SCAN_PERIODS * period_s), notes


def unit_of_offsets(
    times: str, used: Sequence[np.ndarray], period_s: float, lidar: Lidar, usual: TimeUnit
) -> tuple[TimeUnit, tuple[Remark, ...]]:
    """Unit of relative times `used` of some scans with the period period_s: that of the rig file, else the usual one,
    else the only one that gives a plausible duration of scans, with a note. times: their name in messages.

    Raises RecordingError if no unit fits.
    """
    bulk = _median([np.ptp(np.percentile(t, _BULK_PERCENT)) for t in used])
    spans = (bulk, _median([np.ptp(t) for t in used]))
    first = lidar.point_time_unit or usual
    fitting: list[TimeUnit] = [unit for span in spans for unit in UNIT_NS if _fits(span, unit, period_s)]
    given = lidar.point_time_unit is not None and bulk * UNIT_NS[first] * 1e-9 <= MAX_SCAN_PERIODS * period_s
    if given or first in fitting:
        return first, ()
    spread = f"{times}, read as {first}, spread over {bulk * UNIT_NS[first] * 1e-9:.4g} s, though scans are "
    spread += f"{period_s:.4g} s apart"
    if not fitting:
        factor = next((f for f in (1e3, 1e6, 1e9) if _fits(bulk * f, first, period_s)), None)
        other = f"they look like another unit; multiply them by {factor:g}, or" if factor else "correct the driver, or"
        raise RecordingError(
            f"{spread}; {other} set point_time_field of {lidar.name} in the rig file to another field."
        )
    if lidar.point_time_unit is not None:
        raise RecordingError(f"{spread}; set point_time_unit of {lidar.name} to {fitting[0]} in the rig file.")
    only = f"they are read as {fitting[0]}, the only unit that fits"
    sentence = f"{spread}; {only}; point_time_unit of {lidar.name} in the rig file may say otherwise."
    note = Remark("point_time_unit_recognised", sentence)
    return fitting[0], (note,)


def likely_fields(scans: Sequence[np.ndarray]) -> list[str]:
    """Fields of the structured arrays `scans` that are not in FIELDS, but have a name like a time and values that
    differ within a scan."""
    return [n for n in _differing(scans) if _LIKE_A_TIME.search(n) and n not in FIELDS]


def clock_note(what: str, times: PointTimes, stamp_ns: int, first_ns: int) -> Remark | None:
    """A sentence if the clock of point times differs from that of the message stamps, else None. stamp_ns: stamp of a
    message; first_ns: time of its first point."""
    if not times.absolute or times.point_time != "auto" or abs(first_ns - stamp_ns) < 1_000_000_000:
        return None
    return Remark(
        "point_clock_differs",
        f"{what}: the point times `{times.field}` are from another clock than the message stamps, "
        f"{(stamp_ns - first_ns) * 1e-9:.3f} s behind. The clock of the points is used, and time_offset refers "
        "to it.",
    )


def _field(what: str, scans: Sequence[np.ndarray], lidar: Lidar) -> str:
    """The field of point times: that of the rig file, else the first one of FIELDS whose values differ within scans.
    Raises RecordingError if there is none."""
    names, differs = scans[0].dtype.names or (), _differing(scans)
    listed = f"their fields are {', '.join(scans[0].dtype.names or ())}"
    if (given := lidar.point_time_field) is not None:
        if given not in differs:
            wrong = f"all points of a scan have the same `{given}`" if given in names else f"no point has a `{given}`"
            raise RecordingError(
                f"{what}: {wrong} ({listed}); correct point_time_field of {lidar.name} in the rig file."
            )
        return given
    known = [f for f in FIELDS if f in names]
    if usable := [f for f in known if f in differs]:
        return usable[0]
    if likely := likely_fields(scans):
        raise RecordingError(
            f"{what}: the points have no field of times that icalib knows ({listed}); {likely[0]} looks like one: set "
            f"point_time_field: {likely[0]} of {lidar.name} in the rig file."
        )
    if known:
        raise RecordingError(
            f"{what}: all points of a scan have the same `{known[0]}`; correct the driver, or {_POINT_TIME_CHOICES}."
        )
    others = [n for n in differs if n.lower() not in _NO_TIMES]
    if_any = (
        f"set point_time_field of {lidar.name} if one of {', '.join(others)} is their time; else " if others else ""
    )
    raise RecordingError(
        f"{what}: the points have no times ({listed}); {if_any}record a cloud that has them, or {_POINT_TIME_CHOICES}."
    )


def _usual_unit(field: str, are_integers: bool) -> TimeUnit:
    """The unit in the name of the field, else ns for whole numbers and s for others."""
    for unit in UNIT_NS:
        if field.endswith(f"_{unit}"):
            return unit
    return "ns" if are_integers else "s"


def _differing(scans: Sequence[np.ndarray]) -> list[str]:
    """Fields of plain numbers that differ from point to point, in most scans."""
    plain = [n for n in scans[0].dtype.names or () if scans[0][n].ndim == 1]
    return [n for n in plain if np.median([_differ(_decimal(scan[n])) for scan in scans]) > 0]


def _decimal(values: np.ndarray) -> np.ndarray:
    """(N,) float64, NaN for values that are not finite or too large for a time."""
    with np.errstate(invalid="ignore"):  # some bytes are NaN that signal
        times = values.astype(np.float64)
        return np.where(np.abs(times) < _MAX_TIME, times, np.nan)


def _differ(values: np.ndarray) -> bool:
    """Whether the times (N,) of points differ."""
    timed = values[_timed(values, True)]
    return bool(len(timed) and timed.max() > timed.min())


def _timed(times: np.ndarray, absolute: bool) -> np.ndarray:
    """(N,) bool: the point has a time. Drivers write an absolute time of 0 for beams without return."""
    return np.isfinite(times) & ((times != 0) | (not absolute))


def _median(values: Sequence[float]) -> float:
    """Median of some numbers."""
    return float(np.median(values))


def _fits(span: float, unit: TimeUnit, period_s: float) -> bool:
    """True if `span`, in `unit`, is a plausible duration of a scan with the period period_s."""
    return _MIN_SCAN_PERIODS <= span * UNIT_NS[unit] * 1e-9 / period_s <= MAX_SCAN_PERIODS


def _clock_instants(used: Sequence[np.ndarray], period_s: float) -> np.ndarray | None:
    """One time per scan (S,) if times are absolute, increasing from scan to scan; else None. It is the last time, or
    the median if there are outliers."""
    if len(used) < 2:
        return None
    lasts, middles = np.array([t.max() for t in used]), np.array([np.median(t) for t in used])
    if np.median(np.diff(lasts)) > 0.5 * np.median(lasts - [t.min() for t in used]):
        return lasts
    step, bulk = np.median(np.diff(middles)), _median([np.ptp(np.percentile(t, _BULK_PERCENT)) for t in used])
    return middles if step > 0.5 * bulk and _clock_units(float(step), period_s) else None


def _clock_units(step: float, period_s: float) -> list[TimeUnit]:
    """Units in which times that increase by `step` from scan to scan match the scan period: one or none."""
    return [u for u, ns in UNIT_NS.items() if 1.0 / _MAX_PERIOD_RATIO < step * ns * 1e-9 / period_s < _MAX_PERIOD_RATIO]


def _unit_of_clock(what: str, field: str, ends: np.ndarray, period_s: float, lidar: Lidar) -> TimeUnit:
    """Unit of absolute times, from the scan period. Raises RecordingError if no unit fits, or if that of the rig file
    does not."""
    step, given = float(np.median(np.diff(ends))), lidar.point_time_unit
    fitting = _clock_units(step, period_s)
    if given in fitting or (fitting and given is None):
        return given or fitting[0]
    goes = f"{what}: `{field}` increases by {step:.4g} from scan to scan, which is {period_s:.4g} s in"
    if fitting:
        raise RecordingError(f"{goes} {fitting[0]}, not in {given}; correct point_time_unit of {lidar.name}.")
    raise RecordingError(
        f"{goes} no unit (s, ms, us, ns); correct the driver, or set point_time_field of {lidar.name} in the rig file."
    )


# Instants of points from their azimuths, for clouds of spinning LiDARs without point times.

_TURN = 2.0 * np.pi
_MIN_TURNS = 0.5  # turns per scan; a LiDAR with fewer oscillates, or its points are not in order of azimuth
_MIN_TURNS_BY_ROWS = 1.5  # turns per scan; with more, the message contains one ring after another
_SEAM_TURNS = 0.25  # points that near to the first column may belong to either end of the scan


@dataclass(frozen=True)
class SweepOrder:
    """Order of points in a scan. direction: 1 counterclockwise seen from above, -1 clockwise. by_rows: the message
    contains one ring after another; otherwise one column after another."""

    direction: int
    by_rows: bool


def find_sweep(scans: Sequence[np.ndarray]) -> SweepOrder | None:
    """Order of points, found from the points (N, 3) of some scans in message order; None if the LiDAR does not spin."""
    turned = np.array([_turned(xyz) for xyz in scans])
    middle = float(np.median(turned))
    if abs(middle) < _MIN_TURNS:
        return None
    return SweepOrder(1 if middle > 0 else -1, abs(middle) > _MIN_TURNS_BY_ROWS)


def sweep_share(sweep: SweepOrder, xyz: np.ndarray, height: int) -> np.ndarray:
    """(N,) time of each point (N, 3) since the first column, as a share of a turn; NaN for points that are zero or not
    finite. height: number of rows of an organised message.

    Lasers of a column have slightly different azimuths. A point near the first column may thus belong to the beginning
    or the end of the scan; its position in the message decides.
    """
    n = len(xyz)
    usable = _usable(xyz)
    share = np.full(n, np.nan)
    if not usable.any():
        return share
    organised = height > 1 and n % height == 0
    place = np.arange(n) / n
    if sweep.by_rows:
        place = np.arange(n) % (n // height) / (n // height) if organised else np.full(n, 0.5)
    first = np.flatnonzero(usable)[np.argmin(place[usable])]
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0], dtype=np.float64)
    passed = np.mod(sweep.direction * (azimuth - azimuth[first]) / _TURN, 1.0)
    passed -= (passed > 1.0 - _SEAM_TURNS) & (place < _SEAM_TURNS)
    passed += (passed < _SEAM_TURNS) & (place > 1.0 - _SEAM_TURNS)
    share[usable] = passed[usable] + (place[first] if organised else 0.0)
    return share


def _usable(xyz: np.ndarray) -> np.ndarray:
    """(N,) whether points (N, 3) are finite and have an azimuth."""
    return np.isfinite(xyz).all(axis=1) & (xyz[:, :2] != 0).any(axis=1)


def _turned(xyz: np.ndarray) -> float:
    """Number of turns over the successive points (N, 3), positive counterclockwise."""
    used = xyz[_usable(xyz)]
    step = np.diff(np.arctan2(used[:, 1], used[:, 0], dtype=np.float64))
    return float((np.mod(step + np.pi, _TURN) - np.pi).sum() / _TURN)


# Removes repeated scans and scans with wrong stamps, and sorts scans that are out of order.

_N_RECENT_SCANS = 4  # among which a copy is searched; messages overtake only a few others
_MAX_DELAY_S = 1.0  # of a message that others overtake on the network
_MIN_NEIGHBOUR_PERIODS = 0.5  # least distance in time of a late scan from its neighbours after sorting
_MIN_EVEN_SCANS = 10  # needed for a robust estimate of the scatter of stamps
# A stamp is wrong if its error exceeds both: a share of the period, and a number of standard deviations of all stamps.
_MAX_STAMP_ERROR, _SIGNIFICANT_STAMP_ERROR = 0.05, 8.0
_SCAN_ENDS_PERCENT = (1.0, 99.0)  # percentiles of point times at the ends of a scan, robust against outliers
_ISOLATED_S = 10.0  # a first or last scan further in time from all other scans has a wrong stamp
_MAX_BAD_STAMPS = 0.1  # of all scans; with more, the clock was set back


def without_repeats(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[Remark, ...]]:
    """The stream without scans that repeat the points of a recent scan, whatever their stamp, and a note."""
    recent: deque[np.ndarray] = deque(maxlen=_N_RECENT_SCANS)
    fresh = np.ones(len(stream.stamps_ns), bool)
    for i in range(len(fresh)):
        xyz = stream.xyz[stream.start[i] : stream.start[i + 1]]
        fresh[i] = not any(_same(xyz, earlier) for earlier in recent)
        if fresh[i]:
            recent.append(xyz)
    if fresh.all():
        return stream, ()
    lost = stream.stamps_ns[~fresh]
    sentence = f"{what}: {len(lost)} scans that repeat an earlier one exactly were dropped, the first at {lost[0]} ns."
    note = Remark("scans_repeated", sentence)
    return selected(stream, np.flatnonzero(fresh)), (note,)


def in_order(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[Remark, ...]]:
    """The stream with strictly increasing stamps, and notes: late scans are sorted, and single scans with a wrong stamp
    are left out.

    Raises RecordingError naming the instant if wrong stamps are too many.
    """
    stamps_ns = stream.stamps_ns
    kept = _without_isolated_ends(stamps_ns, _longest_increasing(stamps_ns))
    if len(kept) == len(stamps_ns):
        return stream, ()
    order, late, bad = _sorted_by_stamp(stamps_ns, kept)
    if len(bad) > max(1.0, _MAX_BAD_STAMPS * len(stamps_ns)):
        i = int(np.argmax(np.diff(stamps_ns) <= 0))
        raise RecordingError(
            f"{what}: the scan at {stamps_ns[i + 1]} ns comes after the one at {stamps_ns[i]} ns; record again if the "
            "clock was set back, or sort the scans."
        )
    notes = ()
    if late:
        note = Remark(
            "scans_out_of_order",
            f"{what}: {len(late)} scans are out of order, the first at {stamps_ns[late[0]]} ns; all were "
            "sorted by stamp.",
        )
        notes += (note,)
    if bad:
        note = Remark(
            "scan_stamps_wrong",
            f"{what}: {len(bad)} of {len(stamps_ns)} scans have a stamp that does not fit their neighbours' "
            f"and were removed, the first at {stamps_ns[bad[0]]} ns.",
        )
        notes += (note,)
    return selected(stream, order), notes


def with_even_stamps(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[Remark, ...]]:
    """The stream with even stamps if a computer stamps scans on arrival that the LiDAR takes evenly, and a note."""
    if (even := even_stamps(stream.stamps_ns, partial(_spans_follow, stream))) is None:
        return stream, ()
    return replace(stream, stamps_ns=even.stamps_ns), (even.note(what, "scans"),)


def _spans_follow(stream: LidarStream, number: np.ndarray, delay: np.ndarray) -> tuple[float, float]:
    """See `Follows`: whether the points of a scan span more time where its stamp is farther from the next one, as with
    a head that turns unevenly, or scans that are cut at packets."""
    last, first = (extreme.reduceat(stream.offset_s, stream.start[:-1]) for extreme in (np.maximum, np.minimum))
    period_s = 1e-9 * float(np.median(np.diff(stream.stamps_ns)))
    span = (last - first)[:-1].astype(np.float64) / period_s
    longer, step = np.where(np.diff(number) == 1, span - np.median(span), 0.0), np.diff(delay)
    total = float((step**2).sum())
    share = float((longer * step).sum()) / total
    return share, float(np.sqrt((((longer - share * step) * step) ** 2).sum())) / total


def at_even_steps(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[Remark, ...]]:
    """The stream without scans that are stamped too early or too late between neighbours two periods apart, and a note.

    All scans are kept if there are many such scans. A scan is kept if only its begin or its end is off, as part of it
    may be missing.
    """
    stamps_ns = stream.stamps_ns
    if len(stamps_ns) < _MIN_EVEN_SCANS:
        return stream, ()
    period_ns = float(np.median(np.diff(stamps_ns)))
    off = stamps_ns[1:-1] - (stamps_ns[:-2] + (stamps_ns[2:] - stamps_ns[:-2]) // 2)
    late_ns = max(_MAX_STAMP_ERROR * period_ns, _SIGNIFICANT_STAMP_ERROR * 1.4826 * float(np.median(np.abs(off))))
    between = np.abs(stamps_ns[2:] - stamps_ns[:-2] - 2.0 * period_ns) < 2.0 * _MAX_STAMP_ERROR * period_ns
    odd = 1 + np.flatnonzero((np.abs(off) > late_ns) & between)
    odd = odd[[_is_off(stream, i, late_ns) for i in odd.tolist()]] if len(odd) else odd
    if not len(odd) or len(odd) > _MAX_BAD_STAMPS * len(stamps_ns):
        return stream, ()
    note = Remark(
        "scans_stamped_unevenly",
        f"{what}: {len(odd)} of {len(stamps_ns)} scans are stamped more than {_MAX_STAMP_ERROR:.0%} of a period too "
        f"early or too late relative to their neighbours and were removed, the first at {stamps_ns[odd[0]]} ns.",
    )
    return selected(stream, np.setdiff1d(np.arange(len(stamps_ns)), odd)), (note,)


def _is_off(stream: LidarStream, i: int, late_ns: float) -> bool:
    """True if the times of both ends of scan i deviate from the mean of its neighbours' by more than late_ns, in the
    same direction."""
    around = range(i - 1, i + 2)
    ends = [np.percentile(stream.offset_s[stream.start[k] : stream.start[k + 1]], _SCAN_ENDS_PERCENT) for k in around]
    stamps = stream.stamps_ns[i - 1 : i + 2] - stream.stamps_ns[i]
    before, scan, after = (stamp + 1e9 * end for stamp, end in zip(stamps, ends, strict=True))
    off = scan - 0.5 * (before + after)
    return bool((off > late_ns).all() or (off < -late_ns).all())


def selected(stream: LidarStream, scans: np.ndarray) -> LidarStream:
    """The stream with the scans of numbers `scans` (K,), in that order."""
    parts = [slice(stream.start[i], stream.start[i + 1]) for i in scans.tolist()]
    counts = [part.stop - part.start for part in parts]
    columns = {name: np.concatenate([getattr(stream, name)[p] for p in parts]) for name in ("offset_s", "xyz", "plane")}
    start = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    return replace(stream, stamps_ns=stream.stamps_ns[scans], start=start, **columns)


def _same(points: np.ndarray, others: np.ndarray) -> bool:
    """Whether two scans have equal points. The first 8 are compared first, as they differ in nearly all scans."""
    return len(points) == len(others) and (points[:8] == others[:8]).all() and np.array_equal(points, others)


def _without_isolated_ends(stamps_ns: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The scan numbers `kept` (K,) without a first or last scan that is far in time from all others, as its stamp may
    be wrong."""
    if len(kept) < _MIN_EVEN_SCANS:
        return kept
    first, last = (abs(int(stamps_ns[kept[a]] - stamps_ns[kept[b]])) > _ISOLATED_S * 1e9 for a, b in ((0, 1), (-1, -2)))
    return kept[int(first) : len(kept) - int(last)]


def _sorted_by_stamp(stamps_ns: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, list[int], list[int]]:
    """Numbers (K,) of the kept and the late scans, sorted by stamp; numbers of the late scans; and numbers of scans
    with wrong stamps, which would collide with another scan or have no neighbour."""
    period_ns = float(np.median(np.diff(stamps_ns[kept]))) if len(kept) > 1 else np.inf
    placed, order = stamps_ns[kept].tolist(), kept.tolist()
    late: list[int] = []
    bad: list[int] = []
    for i in np.setdiff1d(np.arange(len(stamps_ns)), kept).tolist():
        stamp = int(stamps_ns[i])
        came_with = int(stamps_ns[kept[max(np.searchsorted(kept, i) - 1, 0)]])
        at = bisect_left(placed, stamp)
        gaps = [abs(stamp - placed[k]) / period_ns for k in (at - 1, at) if 0 <= k < len(placed)]
        if (
            abs(stamp - came_with) < _MAX_DELAY_S * 1e9
            and min(gaps) > _MIN_NEIGHBOUR_PERIODS
            and min(gaps) < 1.0 + _MIN_NEIGHBOUR_PERIODS
        ):
            late.append(i)
            placed.insert(at, stamp)
            order.insert(at, i)
        else:
            bad.append(i)
    return np.array(order), late, bad


def _longest_increasing(stamps_ns: np.ndarray) -> np.ndarray:
    """Indices (K,) of the longest strictly increasing subsequence (patience sorting)."""
    values = stamps_ns.tolist()
    tails: list[int] = []  # the smallest last value of an increasing subsequence of each length
    at: list[int] = []  # index of that value
    before = np.full(len(values), -1)
    for i, value in enumerate(values):
        length = bisect_left(tails, value)
        before[i] = at[length - 1] if length else -1
        tails[length : length + 1], at[length : length + 1] = [value], [i]
    chain = [at[-1]]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])
