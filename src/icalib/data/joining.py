"""Joins several recordings of a rig: shifts their clocks so that the recordings follow one another with pauses."""

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
    """One recording of a joined set.

    measurements: as recorded, before the shift. shift_ns: added to all its stamps. rows: by stream key, the stamps of
    the joined stream that belong to this recording. begin: its first stamp of the reference sensor, in seconds from
    that of the first recording on the joined clock.
    """

    measurements: Measurements
    shift_ns: int
    rows: Mapping[str, slice]
    begin: float

    @property
    def name(self) -> str:
        return self.measurements.name


def join(
    rig: Rig, recordings: Sequence[Measurements], shifts_ns: Sequence[int] | None = None
) -> tuple[Measurements, tuple[Part, ...]]:
    """The joined recording, and the place of each recording in it. A single recording stays unchanged.

    shifts_ns: shifts from an earlier join with more streams, to use the same joined clock; default: computed here.

    All clocks of a recording are shifted by the same amount, so that time offsets between sensors remain. The pause
    between two recordings is longer than both. They thus do not overlap for any time offset for which the streams
    within each recording overlap.
    """
    shifts = _shifts(rig, recordings) if shifts_ns is None else shifts_ns
    first, parts, ends = recordings[0].origin_ns, [], dict.fromkeys(recordings[0].streams, 0)
    for m, shift in zip(recordings, shifts, strict=True):
        rows = {key: slice(ends[key], ends[key] + len(s.stamps_ns)) for key, s in m.streams.items()}
        ends = {key: part.stop for key, part in rows.items()}
        parts.append(Part(m, shift, rows, (m.origin_ns + shift - first) * 1e-9))
    return (_joined(recordings, shifts) if len(recordings) > 1 else recordings[0]), tuple(parts)


def _shifts(rig: Rig, recordings: Sequence[Measurements]) -> list[int]:
    """Shift [ns] of the stamps of each recording. Raises RecordingError if several are given and a stream is empty."""
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
    """Length [ns] of the longest stream. Without an IMU, from the first stamp of all sensors to the last, corrected by
    the time offsets of the rig."""
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
    disjoint = _disjoint(recordings)
    streams = {k: type(s).joined([by_key[k] for by_key in disjoint], shifts) for k, s in disjoint[0].items()}
    return Measurements(streams, notes, warnings=warnings)


def _disjoint(recordings: Sequence[Measurements]) -> list[dict[str, Stream]]:
    """The streams of each recording by key, renumbered so that an id (such as of a feature) occurs in one recording
    only."""
    by_recording = [dict(m.streams) for m in recordings]
    for kind in dict.fromkeys(type(s) for s in recordings[0].streams.values()):
        for by_key, streams in zip(by_recording, kind.disjoint([m.of(kind) for m in recordings]), strict=True):
            by_key.update({s.key: s for s in streams})
    return by_recording
