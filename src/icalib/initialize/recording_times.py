"""Streams that were recorded at different times, by stamps that count from 1970."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError

FIRST_UNIX_NS = 10**18  # September 2001; earlier stamps count from the start of a device
HOUR_S = 3600.0  # clocks that are set by hand, or to another time zone, differ by whole hours


@contextmanager
def naming_recording_times(recordings: Sequence[Measurements]) -> Iterator[None]:
    """An EstimationError raised within names two streams of a recording whose stamps lie hours apart, if there are
    any: they do not show the same motion, because they were not recorded together."""
    try:
        yield
    except EstimationError as error:
        for recording in recordings:
            if (found := furthest_apart(recording)) is not None:
                raise EstimationError(_sentence(*found)) from error
        raise


def furthest_apart(recording: Measurements) -> tuple[str, str, float] | None:
    """Names of two sensors, and the seconds from the last stamp of the first to the first stamp of the second, where
    that is more than an hour."""
    spans = [
        (int(s.stamps_ns[0]), int(s.stamps_ns[-1]), s.name)
        for s in recording.streams.values()
        if len(s.stamps_ns) and s.stamps_ns[0] > FIRST_UNIX_NS
    ]
    if not spans:
        return None
    (_, end, first), (begin, _, second) = min(spans, key=lambda s: s[1]), max(spans, key=lambda s: s[0])
    gap = 1e-9 * (begin - end)
    return (first, second, gap) if gap > HOUR_S else None


def _sentence(first: str, second: str, gap: float) -> str:
    days, hours = gap / 86400.0, gap / HOUR_S
    told = f"{days:.1f} days" if days >= 2.0 else f"{hours:.1f} hours"
    return (
        f"{second} was recorded {told} after {first}, by the stamps of both, and does not show the same motion; give "
        "the files of one recording."
    )
