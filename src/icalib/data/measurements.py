"""The streams of all sensors of a recording, and of several recordings as one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from icalib.base.remark import Remark
from icalib.errors import RecordingError
from icalib.rig import Rig
from icalib.sensors import SENSOR_KINDS
from icalib.sensors.camera.stream import CornerStream, TrackStream
from icalib.sensors.imu.stream import ImuStream
from icalib.sensors.lidar.stream import LidarStream
from icalib.sensors.pose.stream import PoseStream
from icalib.sensors.position.stream import PositionStream
from icalib.sensors.sensor import TIME_OFFSET
from icalib.sensors.stream import S, Stream
from icalib.sensors.wheels.stream import WheelPoses, WheelStream

# `Measurements`: the sensor streams of one recording.
#
# Checks that measurements made in memory have a stream for each sensor of the rig. Readers of files ensure this.

__all__ = [
    "CornerStream",
    "ImuStream",
    "LidarStream",
    "Measurements",
    "PoseStream",
    "PositionStream",
    "Stream",
    "TrackStream",
    "WheelPoses",
    "WheelStream",
]


@dataclass(frozen=True)
class Measurements:
    """The sensor streams of one recording.

    streams: by `Stream.key`, sorted by kind of sensor in the order of `SENSOR_KINDS`. notes: data that were rejected or
    repaired while reading, one sentence each. name: of the recording, for messages. warnings: faults of the streams,
    one sentence each.
    """

    streams: Mapping[str, Stream] = field(default_factory=dict)
    notes: tuple[Remark, ...] = ()
    name: str = ""
    warnings: tuple[Remark, ...] = ()

    def __post_init__(self) -> None:
        ordered = sorted(self.streams.items(), key=lambda item: SENSOR_KINDS.index(item[1].sensor_type))
        object.__setattr__(self, "streams", dict(ordered))

    @classmethod
    def of_streams(cls, *streams: Stream, notes: tuple[Remark, ...] = (), name: str = "") -> Measurements:
        """Measurements of these streams. Raises RecordingError if two streams have the same key."""
        by_key = {s.key: s for s in streams}
        if len(by_key) < len(streams):
            twice = next(s.name for k, s in enumerate(streams) if s.key in [t.key for t in streams[:k]])
            raise RecordingError(f"{name or 'the recording'} has two streams of {twice}; give one.")
        return cls(by_key, notes, name)

    def of(self, kind: type[S]) -> tuple[S, ...]:
        """All streams of class `kind`."""
        return tuple(s for s in self.streams.values() if isinstance(s, kind))

    def only(self, *sensors: str) -> Measurements:
        """A copy with the streams of `sensors` (names) only. Names without a stream are ignored."""
        return replace(self, streams={k: s for k, s in self.streams.items() if s.name in sensors})

    def without(self, *sensors: str) -> Measurements:
        """A copy without the streams of `sensors` (names)."""
        return replace(self, streams={k: s for k, s in self.streams.items() if s.name not in sensors})

    def with_streams(self, *streams: Stream) -> Measurements:
        """A copy with `streams` added, or in place of those with the same keys."""
        return replace(self, streams={**self.streams, **{s.key: s for s in streams}})

    @property
    def imu(self) -> ImuStream | None:
        return next(iter(self.of(ImuStream)), None)

    @property
    def cameras(self) -> tuple[CornerStream, ...]:
        return self.of(CornerStream)

    @property
    def tracks(self) -> tuple[TrackStream, ...]:
        return self.of(TrackStream)

    @property
    def lidars(self) -> tuple[LidarStream, ...]:
        return self.of(LidarStream)

    @property
    def wheels(self) -> tuple[WheelStream | WheelPoses, ...]:
        return tuple(s for s in self.streams.values() if isinstance(s, WheelStream | WheelPoses))

    @property
    def poses(self) -> tuple[PoseStream, ...]:
        return self.of(PoseStream)

    @property
    def origin_ns(self) -> int:
        """First stamp [ns] of the IMU; without an IMU, that of `reference`."""
        return self.reference.origin_ns if self.imu is None else self.imu.origin_ns

    @property
    def reference(self) -> CornerStream | TrackStream | LidarStream | PoseStream | WheelStream | WheelPoses:
        """Stream of the reference sensor if there is no IMU: the first camera, else LiDAR, pose sensor, or wheels.

        If the cameras have only feature tracks, it is the first LiDAR or pose sensor, or else the first camera.
        """
        alone = (*self.lidars, *self.poses)
        follow = bool(self.tracks) and not any(len(c.uv) for c in self.cameras)
        return (*alone, *self.tracks)[0] if follow else (*self.cameras, *alone, *self.wheels)[0]

    @property
    def has_clock(self) -> bool:
        """False for pictures that are ordered by their numbers: their stamps are whole seconds, and no times."""
        if self.imu is not None or not isinstance(stream := self.reference, CornerStream):
            return True
        return not any(stream.files.values()) or bool((stream.stamps_ns % 1_000_000_000).any())

    def unassociated(self) -> Measurements:
        """A copy in which the association of LiDAR points with planes is unknown."""
        return self.with_streams(*(x.unassociated() for x in self.lidars))


def streams_of_rig(rig: Rig, measurements: Measurements) -> Measurements:
    """The streams in the order of the rig's sensors. A camera has corners, feature tracks, or both.

    Positions far from the origin of their frame, such as UTM coordinates, are shifted close to it, with a note. Raises
    RecordingError if a sensor has no stream, or a stream belongs to no sensor of its kind in the rig.
    """
    m, where = measurements, measurements.name or "the recording"
    for stream in m.streams.values():
        alike = [s.name for s in rig.sensors.values() if s.sensor_type == stream.sensor_type]
        if stream.name not in alike:
            raise RecordingError(
                f"{where} has a stream called {stream.name}, but the rig has {' and '.join(alike) or 'none'} of its "
                "kind; give it the sensor's name, or add the sensor to the rig."
            )
    given = {s.name for s in m.streams.values()}
    missing = [name for name in rig.sensors if name not in given]
    if missing:
        raise RecordingError(
            f"{where} has no data of {' and '.join(missing)}; add the measurements, or remove it from the rig."
        )
    ordered = {s.key: s for name in rig.sensors for s in m.streams.values() if s.name == name}
    return _near_origin(rig, replace(m, streams=ordered))


def far_origin_note(what: str, origin: Iterable[float]) -> Remark:
    """A note on positions that are relative to `origin` (3,) [m] of their frame."""
    x, y, z = origin
    where = f"({x:.0f}, {y:.0f}, {z:.0f}) m of its frame, whose origin is far away"
    return Remark("positions_far_from_origin", f"{what}: positions are relative to {where}.")


def _near_origin(rig: Rig, measurements: Measurements) -> Measurements:
    """The measurements with positions near the origin of their frame. Sensors that share a frame are shifted
    together."""
    owner = {name: sensor.shared_frame or name for name, sensor in rig.sensors.items()}
    far = ((s.name, s.better_origin()) for s in measurements.streams.values())
    origins = {name: origin for name, origin in far if origin is not None}
    streams, notes = dict(measurements.streams), measurements.notes
    for key, stream in measurements.streams.items():
        origin = origins.get(owner[stream.name])
        if origin is None:
            continue
        streams[key] = stream.relative_to(origin)
        notes += (far_origin_note(stream.name, origin),)
    return replace(measurements, streams=streams, notes=notes)


# Joins several recordings of a rig: shifts their clocks so that the recordings follow one another with pauses.

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
        tuple(words.with_sentence(f"{m.name}: {words}") for m in recordings for words in getattr(m, kind))
        for kind in ("notes", "warnings")
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
