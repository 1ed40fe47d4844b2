"""Removes repeated scans and scans with wrong stamps, and sorts scans that are out of order."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import replace
from functools import partial

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.data.stamps.even import even_stamps
from icalib.errors import RecordingError

_N_RECENT_SCANS = 4  # among which a copy is searched; messages overtake only a few others
_MAX_DELAY_S = 1.0  # of a message that others overtake on the network
_MIN_NEIGHBOUR_PERIODS = 0.5  # least distance in time of a late scan from its neighbours after sorting
_MIN_EVEN_SCANS = 10  # needed for a robust estimate of the scatter of stamps
# A stamp is wrong if its error exceeds both: a share of the period, and a number of standard deviations of all stamps.
_MAX_STAMP_ERROR, _SIGNIFICANT_STAMP_ERROR = 0.05, 8.0
_SCAN_ENDS_PERCENT = (1.0, 99.0)  # percentiles of point times at the ends of a scan, robust against outliers
_ISOLATED_S = 10.0  # a first or last scan further in time from all other scans has a wrong stamp
_MAX_BAD_STAMPS = 0.1  # of all scans; with more, the clock was set back


def without_repeats(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[str, ...]]:
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
    note = f"{what}: {len(lost)} scans that repeat an earlier one exactly were dropped, the first at {lost[0]} ns."
    return selected(stream, np.flatnonzero(fresh)), (note,)


def in_order(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[str, ...]]:
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
        notes += (
            f"{what}: {len(late)} scans are out of order, the first at {stamps_ns[late[0]]} ns; all were "
            "sorted by stamp.",
        )
    if bad:
        notes += (
            f"{what}: {len(bad)} of {len(stamps_ns)} scans have a stamp that does not fit their neighbours' "
            f"and were removed, the first at {stamps_ns[bad[0]]} ns.",
        )
    return selected(stream, order), notes


def with_even_stamps(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[str, ...]]:
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


def at_even_steps(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[str, ...]]:
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
    note = (
        f"{what}: {len(odd)} of {len(stamps_ns)} scans are stamped more than {_MAX_STAMP_ERROR:.0%} of a period too "
        f"early or too late relative to their neighbours and were removed, the first at {stamps_ns[odd[0]]} ns."
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
