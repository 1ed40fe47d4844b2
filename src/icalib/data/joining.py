"""Several recordings of one rig as one: their clocks are shifted so that they follow one another after a pause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from icalib.data.measurements import (
    CornerStream,
    ImuStream,
    LidarStream,
    Measurements,
    PoseStream,
    Stream,
    TrackStream,
    WheelPoses,
    WheelStream,
)
from icalib.errors import RecordingError
from icalib.rig import Rig

PAUSE_NS = 10_000_000_000


@dataclass(frozen=True)
class Part:
    """One recording among those that were joined, as it was measured.

    shift_ns: what was added to all its stamps; images: which of each camera's joined images are its own; begin: its
    first stamp on the joined clock of the body [s].
    """

    measurements: Measurements
    shift_ns: int
    images: tuple[slice, ...]
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
    ends = np.cumsum([[0] * len(rig.cameras), *([len(c.stamps_ns) for c in m.cameras] for m in recordings)], axis=0)
    own = [tuple(slice(int(a), int(b)) for a, b in zip(*pair, strict=True)) for pair in pairwise(ends)]
    first = recordings[0].origin_ns
    parts = tuple(
        Part(m, shift, images, (m.origin_ns + shift - first) * 1e-9)
        for m, shift, images in zip(recordings, shifts, own, strict=True)
    )
    return (_joined(recordings, shifts) if len(recordings) > 1 else recordings[0]), parts


def _streams(measurements: Measurements) -> list[ImuStream | Stream]:
    imus = [] if measurements.imu is None else [measurements.imu]
    return [*imus, *measurements.cameras, *measurements.lidars, *measurements.wheels, *measurements.poses]


def _shifts(rig: Rig, recordings: Sequence[Measurements]) -> list[int]:
    """What to add to the stamps of each recording [ns]. Raises RecordingError where a stream of one is empty."""
    for recording in recordings if len(recordings) > 1 else ():
        empty = [s.name for s in _streams(recording) if not len(s.stamps_ns)]
        if empty:
            raise RecordingError(
                f"{recording.name}: {' and '.join(empty)} has no data that the other recordings could be "
                "joined with (a camera: no image that shows the target); leave this recording out."
            )
    shifts = [0]
    for before, after in pairwise(recordings):
        pairs = zip(_streams(before), _streams(after), strict=True)
        follows = max(int(a.stamps_ns[-1]) - int(b.stamps_ns[0]) for a, b in pairs)
        shifts.append(shifts[-1] + follows + _length_ns(rig, before) + _length_ns(rig, after) + PAUSE_NS)
    return shifts


def _length_ns(rig: Rig, measurements: Measurements) -> int:
    """Of the longest stream; without an IMU from the first stamp of any sensor to the last: offsets are known then."""
    spans = [(int(s.stamps_ns[0]), int(s.stamps_ns[-1])) for s in _streams(measurements)]
    if measurements.imu is not None:
        return max(b - a for a, b in spans)
    given = [s.time_offset.value for s in (*rig.cameras, *rig.lidars, *rig.wheels, *rig.poses)]
    offsets = [0 if v is None else round(1e9 * float(v[0])) for v in given]
    begins, ends = zip(*((a + d, b + d) for (a, b), d in zip(spans, offsets, strict=True)), strict=True)
    return max(ends) - min(begins)


def _joined(recordings: Sequence[Measurements], shifts: Sequence[int]) -> Measurements:
    shifted = list(zip(recordings, shifts, strict=True))
    imus = [(m.imu, shift) for m, shift in shifted if m.imu is not None]
    imu = None
    if imus:
        stamps = np.concatenate([i.stamps_ns + np.int64(shift) for i, shift in imus])
        gyro, accel = np.concatenate([i.gyro for i, _ in imus]), np.concatenate([i.accel for i, _ in imus])
        imu = ImuStream(imus[0][0].name, stamps, gyro, accel)
    cameras = (join_corners([(m.cameras[k], shift) for m, shift in shifted]) for k in range(len(recordings[0].cameras)))
    notes, warnings = (
        tuple(f"{m.name}: {words}" for m in recordings for words in getattr(m, kind)) for kind in ("notes", "warnings")
    )
    lidars = (join_scans([(m.lidars[k], shift) for m, shift in shifted]) for k in range(len(recordings[0].lidars)))
    wheels = (join_wheels([(m.wheels[k], shift) for m, shift in shifted]) for k in range(len(recordings[0].wheels)))
    poses = (join_poses([(m.poses[k], shift) for m, shift in shifted]) for k in range(len(recordings[0].poses)))
    return Measurements(
        imu,
        tuple(cameras),
        notes,
        tracks=_joined_tracks(shifted),
        lidars=tuple(lidars),
        wheels=tuple(wheels),
        poses=tuple(poses),
        warnings=warnings,
    )


def _joined_tracks(recordings: list[tuple[Measurements, int]]) -> tuple[TrackStream, ...]:
    """Tracks of all recordings, each with what to add to its stamps [ns]; a number in two of them is two points."""
    most = [1 + max((int(t.feature.max(initial=-1)) for t in m.tracks), default=-1) for m, _ in recordings]
    least = [min((int(t.feature.min(initial=0)) for t in m.tracks), default=0) for m, _ in recordings]
    sizes = np.cumsum([0, *(a - b for a, b in zip(most, least, strict=True))])
    joined = []
    for k, one in enumerate(recordings[0][0].tracks):
        streams = [m.tracks[k] for m, _ in recordings]
        stamps = [s.stamps_ns + np.int64(shift) for s, (_, shift) in zip(streams, recordings, strict=True)]
        numbers = [s.feature - low + at for s, low, at in zip(streams, least, sizes, strict=False)]
        start = np.concatenate([[0], np.cumsum(np.concatenate([np.diff(s.start) for s in streams]))])
        uv = np.concatenate([s.uv for s in streams])
        stated = {name: np.concatenate([getattr(s, name) for s in streams]) for name in ("views", "spread")}
        joined.append(
            TrackStream(
                one.name,
                np.concatenate(stamps),
                start.astype(np.int64),
                np.concatenate(numbers),
                uv,
                **{name: values for name, values in stated.items() if len(values) == len(uv)},
            )
        )
    return tuple(joined)


def join_corners(streams: list[tuple[CornerStream, int]]) -> CornerStream:
    """One camera's images of all recordings, each with what to add to its stamps [ns]."""
    stamps = np.concatenate([s.stamps_ns + np.int64(shift) for s, shift in streams])
    start = np.concatenate([[0], np.cumsum(np.concatenate([np.diff(s.start) for s, _ in streams]))])
    point, uv = np.concatenate([s.point for s, _ in streams]), np.concatenate([s.uv for s, _ in streams])
    stated = {
        field: np.concatenate([getattr(s, field) for s, _ in streams])
        for field in ("sigma", "edges")
        if all(len(getattr(s, field)) == len(s.uv) for s, _ in streams)
    }
    name, start = streams[0][0].name, start.astype(np.int64)
    files = {stamp + shift: file for s, shift in streams for stamp, file in s.files.items()}
    return CornerStream(name, stamps, start, point, uv, joins_ns=_joins(streams), files=files, **stated)


def join_scans(streams: list[tuple[LidarStream, int]]) -> LidarStream:
    """One LiDAR's scans of all recordings, each with what to add to its stamps [ns]."""
    stamps = np.concatenate([s.stamps_ns + np.int64(shift) for s, shift in streams])
    start = np.concatenate([[0], np.cumsum(np.concatenate([np.diff(s.start) for s, _ in streams]))]).astype(np.int64)
    columns = (np.concatenate([getattr(s, name) for s, _ in streams]) for name in ("offset_s", "xyz", "plane"))
    return LidarStream(streams[0][0].name, stamps, start, *columns, joins_ns=_joins(streams))


def join_wheels(streams: list[tuple[WheelStream | WheelPoses, int]]) -> WheelStream:
    """The readings of all recordings, each with what to add to its stamps [ns]; a mean rate from the end of one to the
    beginning of the next means nothing. Raises RecordingError for relative poses: there is none between recordings."""
    stamps, rates = [], []
    for wheels, shift in streams:
        if isinstance(wheels, WheelPoses):
            raise RecordingError(
                f"{wheels.name} measures relative poses, and there is none between two recordings; give one "
                "recording, or wheels that measure rates, angles or ticks."
            )
        stamps.append(wheels.stamps_ns + np.int64(shift))
        rates.append(wheels.rate)
    first = streams[0][0]
    assert isinstance(first, WheelStream)  # see above
    stamps, rates = np.concatenate(stamps), np.concatenate(rates)
    return WheelStream(first.name, stamps, rates, first.sampling, first.kind, joins_ns=_joins(streams))


def join_poses(streams: list[tuple[PoseStream, int]]) -> PoseStream:
    """The poses of all recordings, each with what to add to its stamps [ns]; each recording has a frame of its own."""
    stamps = np.concatenate([s.stamps_ns + np.int64(shift) for s, shift in streams])
    rotation, position = (np.concatenate([getattr(s, name) for s, _ in streams]) for name in ("rotation", "position"))
    return PoseStream(streams[0][0].name, stamps, rotation, position, joins_ns=_joins(streams))


def _joins(streams: Sequence[tuple[Stream, int]]) -> tuple[int, ...]:
    """The first stamp of each recording but the first."""
    return tuple(int(s.stamps_ns[0]) + shift for s, shift in streams[1:])
