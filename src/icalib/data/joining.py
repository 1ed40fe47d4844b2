"""Several recordings of one rig as one: their clocks are shifted so that they follow one another after a pause."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from icalib.data.measurements import Measurements
from icalib.errors import RecordingError
from icalib.rig import Rig
from icalib.sensors.sensor import TIME_OFFSET
from icalib.sensors.stream import Stream

PAUSE_NS = 10_000_000_000


@dataclass(frozen=True)
class Part:
    """One recording among those that were joined, as it was measured.

    shift_ns: what was added to all its stamps; own: which stamps of each joined stream are its own, by the stream's
    key; begin: its first stamp on the joined clock of the body [s].
    """

    measurements: Measurements
    shift_ns: int
    own: Mapping[str, slice]
    begin: float

    @property
    def name(self) -> str:
        return self.measurements.name


def join(
    rig: Rig, recordings: Sequence[Measurements], shifts_ns: Sequence[int] | None = None
) -> tuple[Measurements, tuple[Part, ...]]:
    """All recordings as one, and where each stands in it; a single one stays as it is. shifts_ns: those of a join of
    these and more streams, which the clock is to go by.

    All clocks of a recording are shifted alike, so that time offsets between raw clocks stay. Whatever these are, two
    recordings stay apart as long as the streams of each overlap: the pause between them is longer than both.
    """
    shifts = _shifts(rig, recordings) if shifts_ns is None else shifts_ns
    first, parts, ends = recordings[0].origin_ns, [], dict.fromkeys(recordings[0].streams, 0)
    for m, shift in zip(recordings, shifts, strict=True):
        own = {key: slice(ends[key], ends[key] + len(s.stamps_ns)) for key, s in m.streams.items()}
        ends = {key: rows.stop for key, rows in own.items()}
        parts.append(Part(m, shift, own, (m.origin_ns + shift - first) * 1e-9))
    return (_joined(recordings, shifts) if len(recordings) > 1 else recordings[0]), tuple(parts)


def _shifts(rig: Rig, recordings: Sequence[Measurements]) -> list[int]:
    """What to add to the stamps of each recording [ns]. Raises RecordingError where a stream of one is empty."""
    for recording in recordings if len(recordings) > 1 else ():
        empty = [s.name for s in recording.streams.values() if not len(s.stamps_ns)]
        if empty:
            raise RecordingError(
                f"{recording.name}: {' and '.join(empty)} has no data that the other recordings could be "
                "joined with (a camera: no image that shows the target); leave this recording out."
            )
    shifts = [0]
    for before, after in pairwise(recordings):
        pairs = [(before.streams[key], s) for key, s in after.streams.items()]
        follows = max(int(a.stamps_ns[-1]) - int(b.stamps_ns[0]) for a, b in pairs)
        shifts.append(shifts[-1] + follows + _length_ns(rig, before) + _length_ns(rig, after) + PAUSE_NS)
    return shifts


def _length_ns(rig: Rig, measurements: Measurements) -> int:
    """Of the longest stream; without an IMU from the first stamp of any sensor to the last: offsets are known then."""
    streams = measurements.streams.values()
    spans = [(int(s.stamps_ns[0]), int(s.stamps_ns[-1])) for s in streams]
    if measurements.imu is not None:
        return max(b - a for a, b in spans)
    given = [getattr(rig.sensors[s.name], TIME_OFFSET.name).value for s in streams]
    offsets = [0 if v is None else round(1e9 * float(v[0])) for v in given]
    begins, ends = zip(*((a + d, b + d) for (a, b), d in zip(spans, offsets, strict=True)), strict=True)
    return max(ends) - min(begins)


def _joined(recordings: Sequence[Measurements], shifts: Sequence[int]) -> Measurements:
    notes, warnings = (
        tuple(f"{m.name}: {words}" for m in recordings for words in getattr(m, kind)) for kind in ("notes", "warnings")
    )
    found = _disjoint(recordings)
    streams = {k: type(s).joined([own[k] for own in found], shifts) for k, s in found[0].items()}
    return Measurements(streams, notes, warnings=warnings)


def _disjoint(recordings: Sequence[Measurements]) -> list[dict[str, Stream]]:
    """The streams of each recording, such that a number in two recordings is two things."""
    found = [dict(m.streams) for m in recordings]
    for kind in dict.fromkeys(type(s) for s in recordings[0].streams.values()):
        for own, streams in zip(found, kind.disjoint([m.of(kind) for m in recordings]), strict=True):
            own.update({s.key: s for s in streams})
    return found
