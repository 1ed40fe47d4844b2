"""Rates, gaps and jitter of stamps."""

from __future__ import annotations

import numpy as np

from icalib.data.stamps.jumps import longest_part
from icalib.tools.inspection.facts import Inspection, Timing

GAP = 1.5  # in median intervals; one lost message makes 2


def timing_of(stamps_ns: np.ndarray) -> Timing | None:
    """Statistics of the stamps (N,) int64 [ns], in the order of recording; None without stamps."""
    if not len(stamps_ns):
        return None
    part, jumps = longest_part(stamps_ns)
    stamps_ns = stamps_ns[part]
    first, last = int(stamps_ns.min()), int(stamps_ns.max())
    steps = np.diff(stamps_ns)
    forward = steps[steps > 0]
    median = float(np.median(forward)) if len(forward) else None
    wide = steps > GAP * median if median else np.zeros(len(steps), bool)
    longest = int(np.argmax(steps)) if wide.any() else None
    steps_without_gaps = forward[forward <= GAP * median] if median else forward
    return Timing(
        count=len(stamps_ns),
        first_ns=first,
        last_ns=last,
        duration_s=(last - first) * 1e-9,
        rate_hz=1e9 / median if median else None,
        jitter_s=1e-9 * float(np.sqrt(np.mean((steps_without_gaps - median) ** 2))) if median else None,
        gaps=int(wide.sum()),
        longest_gap_s=None if longest is None else float(steps[longest]) * 1e-9,
        longest_gap_at_s=None if longest is None else int(stamps_ns[longest] - first) * 1e-9,
        backwards=int((steps < 0).sum()),
        repeated=int((steps == 0).sum()),
        jumps=jumps,
    )


def overlap_s(a: Timing, b: Timing) -> float:
    """Overlap of the two spans of stamps [s]; negative: the gap between them."""
    return (min(a.last_ns, b.last_ns) - max(a.first_ns, b.first_ns)) * 1e-9


def words_on_gaps(t: Timing) -> str:
    """Number, length and instant of the gaps, for a sentence."""
    return (
        f"{t.gaps} gap{'s' * (t.gaps > 1)}, the longest of {t.longest_gap_s or 0.0:.3f} s at "
        f"{t.longest_gap_at_s or 0.0:.2f} s"
    )


def imu_timing(inspection: Inspection) -> Timing | None:
    """Statistics of the stamps of the IMU to calibrate with; None without one."""
    imu = inspection.imu
    return None if imu is None else inspection.stream(inspection.sources.sensors[imu].topic).timing
