"""Scans that are there twice, and scans whose stamps are out of order."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import replace

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.errors import RecordingError

_RECENT = 4  # scans among which a copy is looked for: messages overtake each other by few
_SWAPPED_S = 1.0  # messages overtake each other on the network by less
_ROOM = 0.5  # of a period, that a scan has to both sides where it belongs
_FEWEST_EVEN = 10  # scans that show how even stamps are
_LATE, _SURE = 0.05, 8.0  # of a period, and scatters of the stamps, by which a single one is too early or too late
_ENDS = (1.0, 99.0)  # per cent: the first and the last points of a scan, but for single wrong times
_LONELY_S = 10.0  # from all other scans
_MOST_BAD = 0.1  # share of scans with bad stamps; more of them is a clock that was set back


def without_repeats(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[str, ...]]:
    """`stream` without scans whose points are those of one shortly before, whatever their stamp, and a note."""
    recent: deque[np.ndarray] = deque(maxlen=_RECENT)
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
    """`stream` with strictly increasing stamps, and notes on what was done for it: scans that came late are sorted,
    single ones whose stamp fits nowhere are left out.

    Raises RecordingError naming the instant where these are too many to be errors of single stamps.
    """
    stamps_ns = stream.stamps_ns
    kept = _without_lonely_ends(stamps_ns, _longest_increasing(stamps_ns))
    if len(kept) == len(stamps_ns):
        return stream, ()
    order, late, bad = _sorted_in(stamps_ns, kept)
    if len(bad) > max(1.0, _MOST_BAD * len(stamps_ns)):
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


def at_even_steps(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[str, ...]]:
    """`stream` without single scans that are early or late between two that are a double period apart, and a note. All
    stay where these are many, and where only the first or only the last points of a scan are missing."""
    stamps_ns = stream.stamps_ns
    if len(stamps_ns) < _FEWEST_EVEN:
        return stream, ()
    period_ns = float(np.median(np.diff(stamps_ns)))
    off = stamps_ns[1:-1] - (stamps_ns[:-2] + (stamps_ns[2:] - stamps_ns[:-2]) // 2)
    late_ns = max(_LATE * period_ns, _SURE * 1.4826 * float(np.median(np.abs(off))))
    between = np.abs(stamps_ns[2:] - stamps_ns[:-2] - 2.0 * period_ns) < 2.0 * _LATE * period_ns
    odd = 1 + np.flatnonzero((np.abs(off) > late_ns) & between)
    odd = odd[[_is_off(stream, i, late_ns) for i in odd.tolist()]] if len(odd) else odd
    if not len(odd) or len(odd) > _MOST_BAD * len(stamps_ns):
        return stream, ()
    note = (
        f"{what}: {len(odd)} of {len(stamps_ns)} scans are stamped more than {_LATE:.0%} of a period too early "
        f"or too late relative to their neighbours and were removed, the first at {stamps_ns[odd[0]]} ns."
    )
    return selected(stream, np.setdiff1d(np.arange(len(stamps_ns)), odd)), (note,)


def _is_off(stream: LidarStream, i: int, late_ns: float) -> bool:
    """Whether both the first and the last points of scan i are as far off the middle of its neighbours' ones."""
    around = range(i - 1, i + 2)
    ends = [np.percentile(stream.offset_s[stream.start[k] : stream.start[k + 1]], _ENDS) for k in around]
    stamps = stream.stamps_ns[i - 1 : i + 2] - stream.stamps_ns[i]
    before, own, after = (stamp + 1e9 * end for stamp, end in zip(stamps, ends, strict=True))
    off = own - 0.5 * (before + after)
    return bool((off > late_ns).all() or (off < -late_ns).all())


def selected(stream: LidarStream, scans: np.ndarray) -> LidarStream:
    """The scans (K,) of `stream` by number, in that order."""
    parts = [slice(stream.start[i], stream.start[i + 1]) for i in scans.tolist()]
    counts = [part.stop - part.start for part in parts]
    columns = {name: np.concatenate([getattr(stream, name)[p] for p in parts]) for name in ("offset_s", "xyz", "plane")}
    start = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    return replace(stream, stamps_ns=stream.stamps_ns[scans], start=start, **columns)


def _same(points: np.ndarray, others: np.ndarray) -> bool:
    """Their first points tell nearly all scans apart."""
    return len(points) == len(others) and (points[:8] == others[:8]).all() and np.array_equal(points, others)


def _without_lonely_ends(stamps_ns: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The scans `kept` (K,) but a first or last one that is far from all others: its stamp may be wrong, and alone it
    shows nothing."""
    if len(kept) < _FEWEST_EVEN:
        return kept
    first, last = (abs(int(stamps_ns[kept[a]] - stamps_ns[kept[b]])) > _LONELY_S * 1e9 for a, b in ((0, 1), (-1, -2)))
    return kept[int(first) : len(kept) - int(last)]


def _sorted_in(stamps_ns: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, list[int], list[int]]:
    """Numbers (K,) of scans by stamp: those `kept` and of the others those that came late; these; and those whose stamp
    is wrong: where it would put them there is a scan, or no neighbour."""
    period_ns = float(np.median(np.diff(stamps_ns[kept]))) if len(kept) > 1 else np.inf
    placed, order = stamps_ns[kept].tolist(), kept.tolist()
    late: list[int] = []
    bad: list[int] = []
    for i in np.setdiff1d(np.arange(len(stamps_ns)), kept).tolist():
        stamp = int(stamps_ns[i])
        came_with = int(stamps_ns[kept[max(np.searchsorted(kept, i) - 1, 0)]])
        at = bisect_left(placed, stamp)
        gaps = [abs(stamp - placed[k]) / period_ns for k in (at - 1, at) if 0 <= k < len(placed)]
        if abs(stamp - came_with) < _SWAPPED_S * 1e9 and min(gaps) > _ROOM and min(gaps) < 1.0 + _ROOM:
            late.append(i)
            placed.insert(at, stamp)
            order.insert(at, i)
        else:
            bad.append(i)
    return np.array(order), late, bad


def _longest_increasing(stamps_ns: np.ndarray) -> np.ndarray:
    """(K,) numbers of the longest strictly increasing subsequence (patience sorting)."""
    values = stamps_ns.tolist()
    tails: list[int] = []  # the smallest last value of an increasing subsequence of each length
    at: list[int] = []  # its number
    before = np.full(len(values), -1)
    for i, value in enumerate(values):
        length = bisect_left(tails, value)
        before[i] = at[length - 1] if length else -1
        tails[length : length + 1], at[length : length + 1] = [value], [i]
    found = [at[-1]]
    while before[found[-1]] >= 0:
        found.append(int(before[found[-1]]))
    return np.array(found[::-1])
