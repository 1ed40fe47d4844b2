"""Checks of points and scans: usable points, and stamps that fit the point times."""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.data.stamps.clocks import rate_sentence
from icalib.errors import RecordingError
from icalib.sensors.lidar.read.scan_order import at_even_steps, in_order, selected, with_even_stamps, without_repeats

_SCAN_RATE_HZ = (0.1, 1000.0)  # lowest and highest plausible rate
_MAX_POINT_PERIODS = 2.0  # time from the stamp of a scan to its points, in scan periods
_MAX_FAR_SHARE = 0.1  # of the scans; if more exceed _MAX_POINT_PERIODS, unit or origin of point times is wrong
_POINTS_PER_BATCH = 1_000_000  # bounds the memory


class Sieve:
    """Selects finite points with a time, from min_range_m to max_range_m, and counts all other points by reason."""

    def __init__(self, min_range_m: float, max_range_m: float) -> None:
        self._near_m, self._far_m = min_range_m, max_range_m
        self._total = 0
        self._dropped = np.zeros(5, np.int64)

    def keep(self, xyz: np.ndarray, offset_s: np.ndarray) -> np.ndarray:
        """(N,) bool: the point xyz (N, 3) [m] can be used. offset_s (N,): its time, NaN if it has none."""
        with np.errstate(over="ignore", invalid="ignore"):  # squares of huge values overflow to infinity
            r2 = np.einsum("ij,ij->i", xyz, xyz)
        near, far = r2 < np.float32(self._near_m) ** 2, r2 > np.float32(self._far_m) ** 2
        good, timed = np.isfinite(r2), np.isfinite(offset_s)
        kept = good & timed & ~near & ~far
        self._total += len(r2)
        if not kept.all():
            zero = r2 == 0
            reasons = (~good, good & zero, good & near & ~zero, good & far, good & ~near & ~far & ~timed)
            self._dropped += [np.count_nonzero(reason) for reason in reasons]
        return kept

    def note(self, what: str) -> str | None:
        """A sentence on the points left out of `what`, by reason; None if all were kept."""
        if not self._dropped.any():
            return None
        words = (
            "without numbers",
            "at zero",
            f"nearer than {self._near_m:g} m",
            f"farther than {self._far_m:g} m",
            "without a time within their scan",
        )
        parts = [f"{count} {why}" for count, why in zip(self._dropped, words, strict=True) if count]
        return f"{what}: of {self._total} points {', '.join(parts)} were left out."


def sifted(stream: LidarStream, sieve: Sieve) -> LidarStream:
    """The stream with the points that the sieve keeps; a scan may become empty. Reuses the arrays of `stream`, which
    are invalid afterwards, as a second cloud may not fit in memory."""
    n = len(stream.xyz)
    columns = (stream.offset_s, stream.xyz, stream.plane)
    keep = np.empty(n, bool)
    kept = 0
    for begin in range(0, n, _POINTS_PER_BATCH):
        part = slice(begin, min(begin + _POINTS_PER_BATCH, n))
        keep[part] = sieve.keep(stream.xyz[part], stream.offset_s[part])
        count = int(np.count_nonzero(keep[part]))
        for column in columns:
            column[kept : kept + count] = column[part][keep[part]]
        kept += count
    start = stream.start - np.searchsorted(np.flatnonzero(~keep), stream.start)
    return LidarStream(stream.name, stream.stamps_ns, start, *(column[:kept] for column in columns))


def checked_lidar(stream: LidarStream, where: str) -> tuple[LidarStream, tuple[str, ...]]:
    """`stream` without scans that are empty, repeat a recent scan, or have a wrong stamp; and notes on these.

    Raises RecordingError naming `where` and the instant: fewer than two scans with points, a clock that was set back,
    an implausible rate, or points far from the stamp of their scan.
    """
    what = f"{where} ({stream.name})"
    filled = np.diff(stream.start) > 0
    if filled.sum() < 2:
        raise RecordingError(
            f"{what}: {int(filled.sum())} of {len(filled)} scans have usable points; a calibration needs the "
            "whole recording. Check the driver, and min_range and max_range in the rig file."
        )
    notes = ()
    if not filled.all():
        notes = (f"{what}: {int((~filled).sum())} of {len(filled)} scans have no usable point and were left out.",)
        start = np.append(stream.start[:-1][filled], stream.start[-1])
        stream = LidarStream(stream.name, stream.stamps_ns[filled], start, stream.offset_s, stream.xyz, stream.plane)
    for check in (without_repeats, in_order, with_even_stamps, at_even_steps):
        stream, more = check(stream, what)
        notes += more
    if len(stream.stamps_ns) < 2:
        raise RecordingError(
            f"{what}: all scans are the same; the LiDAR or its driver froze; restart it, and record again."
        )
    sentence = rate_sentence(what, stream.stamps_ns, *_SCAN_RATE_HZ)
    if sentence:
        raise RecordingError(sentence)
    stream, more = _near_their_stamps(stream, what)
    return stream, notes + more


def _near_their_stamps(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[str, ...]]:
    """The stream without scans whose points are far in time from the stamp, and a note. Raises RecordingError if there
    are many such scans."""
    period_s = float(np.median(np.diff(stream.stamps_ns))) * 1e-9
    low, high = (extreme.reduceat(stream.offset_s, stream.start[:-1]) for extreme in (np.minimum, np.maximum))
    far = np.maximum(-low, high) > _MAX_POINT_PERIODS * period_s
    if not far.any():
        return stream, ()
    if far.mean() > _MAX_FAR_SHARE:
        raise RecordingError(
            f"{what}: points are {low[far].min():.4g} to {high[far].max():.4g} s from the stamp of their scan, "
            f"but scans are {period_s:.4g} s apart; write point times relative to the stamp of the scan."
        )
    first = stream.stamps_ns[np.argmax(far)]
    note = (
        f"{what}: {int(far.sum())} of {len(far)} scans have points that are far from their stamp and were left out, "
        f"the first at {first} ns."
    )
    return selected(stream, np.flatnonzero(~far)), (note,)
