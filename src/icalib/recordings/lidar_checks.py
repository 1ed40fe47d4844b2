"""Which points of a LiDAR can be used, and whether its scans are timed as they should be."""

from __future__ import annotations

import numpy as np

from icalib.errors import RecordingError
from icalib.measurements import LidarStream
from icalib.recordings.clocks import rate_sentence

_RATE_HZ = (0.1, 1000.0)
_SPAN_PERIODS = (0.02, 1.7)  # how long a scan may take: a narrow sector of a turn, up to scans that overlap
_FACTORS = (1e3, 1e6, 1e9)
_BATCH = 1_000_000  # points at a time


class Sieve:
    """Keeps the points from near_m to far_m, and counts the others."""

    def __init__(self, near_m: float, far_m: float) -> None:
        self._near_m, self._far_m = near_m, far_m
        self._total = 0
        self._dropped = np.zeros(4, np.int64)

    def keep(self, xyz: np.ndarray, offset_s: np.ndarray) -> np.ndarray:
        """(N,) bool: which of the points (N, 3) [m], at offset_s (N,), can be used."""
        r2 = np.einsum("ij,ij->i", xyz, xyz)
        near, far = r2 < np.float32(self._near_m) ** 2, r2 > np.float32(self._far_m) ** 2
        good = np.isfinite(r2) & np.isfinite(offset_s)
        kept = good & ~near & ~far
        self._total += len(r2)
        if not kept.all():
            zero = r2 == 0
            reasons = (~good, good & zero, good & near & ~zero, good & far)
            self._dropped += [np.count_nonzero(reason) for reason in reasons]
        return kept

    def note(self, what: str) -> str | None:
        """A sentence on what was left out of `what`; None where all points were kept."""
        if not self._dropped.any():
            return None
        words = (
            "without numbers", "at zero", f"nearer than {self._near_m:g} m", f"farther than {self._far_m:g} m"
        )  # fmt: skip
        parts = [f"{count} {why}" for count, why in zip(self._dropped, words, strict=True) if count]
        return f"{what}: of {self._total} points {', '.join(parts)} were left out."


def sifted(stream: LidarStream, sieve: Sieve) -> LidarStream:
    """`stream` with those of its points that the sieve keeps; a scan may lose all. What is kept moves up in the arrays
    of `stream` itself, which are no longer of use: a second cloud would not fit in memory."""
    n = len(stream.xyz)
    columns = (stream.offset_s, stream.xyz, stream.plane)
    keep = np.empty(n, bool)
    kept = 0
    for begin in range(0, n, _BATCH):
        part = slice(begin, min(begin + _BATCH, n))
        keep[part] = sieve.keep(stream.xyz[part], stream.offset_s[part])
        count = int(np.count_nonzero(keep[part]))
        for column in columns:
            column[kept : kept + count] = column[part][keep[part]]
        kept += count
    start = stream.start - np.searchsorted(np.flatnonzero(~keep), stream.start)
    return LidarStream(stream.name, stream.stamps_ns, start, *(column[:kept] for column in columns))


def checked_lidar(stream: LidarStream, where: str) -> tuple[LidarStream, tuple[str, ...]]:
    """`stream` without scans that have no points, and notes on these.

    Raises RecordingError naming `where` and the instant: fewer than two scans with points, stamps that do not increase,
    at an impossible rate, or points timed in another unit.
    """
    what = f"{where} ({stream.name})"
    filled = np.diff(stream.start) > 0
    if filled.sum() < 2:
        raise RecordingError(
            f"{what}: {int(filled.sum())} of {len(filled)} scans have usable points; a calibration needs the whole "
            "recording; check the driver, and near and far in the rig file."
        )
    notes = ()
    if not filled.all():
        notes = (f"{what}: {int((~filled).sum())} of {len(filled)} scans have no usable point and were left out.",)
        start = np.append(stream.start[:-1][filled], stream.start[-1])
        stream = LidarStream(stream.name, stream.stamps_ns[filled], start, stream.offset_s, stream.xyz, stream.plane)
    refuse_disorder(stream.stamps_ns, what)
    sentence = rate_sentence(what, stream.stamps_ns, *_RATE_HZ)
    if sentence:
        raise RecordingError(sentence)
    _refuse_other_units(stream, what, float(np.median(np.diff(stream.stamps_ns))) * 1e-9)
    return stream, notes


def refuse_disorder(stamps_ns: np.ndarray, what: str) -> None:
    """Raises RecordingError where a scan is not later than the one before."""
    late = np.diff(stamps_ns) <= 0
    if late.any():
        i = int(np.argmax(late))
        raise RecordingError(
            f"{what}: the scan at {stamps_ns[i + 1]} ns comes after the one at {stamps_ns[i]} ns; record again if the "
            "clock was set back, or sort the scans."
        )


def _refuse_other_units(stream: LidarStream, what: str, period_s: float) -> None:
    low, high = float(stream.offset_s.min()), float(stream.offset_s.max())
    span = high - low
    sentence = span_sentence(f"{what}: the times of a scan's points", span, period_s) if span else None
    if sentence:
        raise RecordingError(sentence)
    if max(-low, high) > 2.0 * period_s:
        raise RecordingError(
            f"{what}: points are {low:.4g} to {high:.4g} s from their scan's stamp, though scans are {period_s:.4g} s "
            "apart; write the times of points from the stamp of their scan."
        )


def span_sentence(times: str, span_s: float, period_s: float) -> str | None:
    """A sentence saying that `times` do not fit scans that are period_s apart, None if they do. Names the factor
    between units where it looks like one."""
    low, high = _SPAN_PERIODS
    if low <= span_s / period_s <= high:
        return None
    spread = f"{times} spread over {span_s:.4g} s, though scans are {period_s:.4g} s apart"
    for factor in _FACTORS:
        if low <= span_s / factor / period_s <= high:
            return f"{spread}; they look like another unit; divide them by {factor:g}."
        if low <= span_s * factor / period_s <= high:
            return f"{spread}; they look like another unit; multiply them by {factor:g}."
    return f"{spread}; correct what writes them."
