"""Time window of a recording, in seconds from its start (`--from`, `--to`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isnan

import numpy as np

from icalib.data.stamps.sections import S, section
from icalib.errors import RecordingError

Span = tuple[int, int]  # first and last stamp, ns
_LONGEST_NS = 86_400_000_000_000  # one day: the clock of a longer stream is assumed to jump


@dataclass(frozen=True)
class Window:
    """Time window [start_s, end_s) from the start of the recording. Raises RecordingError for NaN, a negative start, or
    an end that is not after the start."""

    start_s: float = 0.0
    end_s: float = inf

    def __post_init__(self) -> None:
        if isnan(self.start_s) or not 0.0 <= self.start_s < inf:
            raise RecordingError(f"--from must be seconds after the start of the recording, not {self.start_s:g}.")
        if not self.end_s > self.start_s:
            raise RecordingError(f"--to must be seconds after --from ({self.start_s:g}), not {self.end_s:g}.")

    @property
    def is_all(self) -> bool:
        return self.start_s == 0.0 and self.end_s == inf

    def bounds(self, origin_ns: int) -> Span:
        """First stamp [ns] in the window, and first after it, for a recording that starts at origin_ns."""
        end = origin_ns + round(self.end_s * 1e9) if self.end_s < inf else 2**63 - 1
        return origin_ns + round(self.start_s * 1e9), min(end, 2**63 - 1)

    def note(self, where: str) -> str:
        end = f"to {self.end_s:g} s" if self.end_s < inf else "on"
        return f"{where}: only the part from {self.start_s:g} s after its start {end} is used."

    def refuse(self, what: str, length_s: float) -> RecordingError:
        """The error for a window without data. length_s: length of the data from the start of the recording."""
        end = "the end" if self.end_s == inf else f"{self.end_s:g}"
        return RecordingError(
            f"{what}: there is nothing from {self.start_s:g} s to {end}, the whole lasts {length_s:.4g} s; "
            "correct --from and --to."
        )


WHOLE_RECORDING = Window()


def cut(window: Window, stream: S, what: str, spans: Sequence[Span]) -> S:
    """The section of `stream` in the window, counted from the start of the recording on its clock (`start_of`).

    what: its name in messages. spans: of all streams of the recording. Raises RecordingError if the window is empty.
    """
    if window.is_all or not len(stream.stamps_ns):
        return stream
    inside = np.flatnonzero(stamps_inside(window, stream.stamps_ns, what, spans))
    return section(stream, int(inside[0]), int(inside[-1]) + 1)


def stamps_inside(window: Window, stamps_ns: np.ndarray, what: str, spans: Sequence[Span]) -> np.ndarray:
    """(N,) bool: stamps in the window, as `cut`. Raises RecordingError if there are none."""
    span = int(stamps_ns.min()), int(stamps_ns.max())
    origin = start_of(span, spans)
    low, high = window.bounds(origin)
    inside = (stamps_ns >= low) & (stamps_ns < high)
    if not inside.any():
        raise window.refuse(what, (span[1] - origin) * 1e-9)
    return inside


def start_of(span: Span, spans: Sequence[Span]) -> int:
    """Start of the recording [ns] on the clock of a stream. span: its first and last stamp [ns]; spans: those of all
    streams.

    It is the first stamp of all streams whose spans overlap that span, directly or through other streams. A stream with
    a clock jump (longer than a day), or with another clock, starts at its first stamp.
    """
    first, last = span
    if last - first > _LONGEST_NS:
        return first
    waiting = [s for s in spans if s[1] - s[0] <= _LONGEST_NS]
    while overlapping := [s for s in waiting if s[0] <= last and s[1] >= first]:
        first, last = min(first, *(s[0] for s in overlapping)), max(last, *(s[1] for s in overlapping))
        waiting = [s for s in waiting if s not in overlapping]
    return first
