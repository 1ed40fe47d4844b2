"""Detects streams that were recorded at different times, by stamps in Unix time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.initialize.steps.initializer import OtherMotionError

FIRST_UNIX_NS = 10**18  # September 2001; earlier stamps are no Unix time and are not compared
HOUR_S = 3600.0  # s between the streams, above which they count as recorded at different times


@contextmanager
def naming_recording_times(recordings: Sequence[Measurements]) -> Iterator[None]:
    """A context for errors of streams that were not recorded together. An OtherMotionError is replaced by one that
    names two streams of a recording more than an hour apart, if there are any."""
    try:
        yield
    except OtherMotionError as error:
        for recording in recordings:
            if (streams := furthest_apart(recording)) is not None:
                raise EstimationError(_sentence(*streams)) from error
        raise


def furthest_apart(recording: Measurements) -> tuple[str, str, float] | None:
    """Names of two sensors, and the time [s] from the last stamp of the first to the first stamp of the second. None if
    this is at most an hour for all pairs."""
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
    delay = f"{days:.1f} days" if days >= 2.0 else f"{hours:.1f} hours"
    return (
        f"{second} was recorded {delay} after {first}, by the stamps of both, and does not show the same motion; give "
        "the files of one recording."
    )
