"""What one recording holds: the streams of its sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from icalib.errors import RecordingError
from icalib.sensors import SENSOR_KINDS
from icalib.sensors.camera.stream import CornerStream, TrackStream
from icalib.sensors.imu.stream import ImuStream
from icalib.sensors.lidar.stream import LidarStream
from icalib.sensors.pose.stream import PoseStream
from icalib.sensors.stream import S, Stream
from icalib.sensors.wheels.stream import WheelPoses, WheelStream

__all__ = [
    "CornerStream",
    "ImuStream",
    "LidarStream",
    "Measurements",
    "PoseStream",
    "Stream",
    "TrackStream",
    "WheelPoses",
    "WheelStream",
]


@dataclass(frozen=True)
class Measurements:
    """What one recording holds of the sensors of a rig.

    streams: by `Stream.key`, sorted by kind of sensor in the order of `SENSOR_KINDS`; notes: what was dropped or
    repaired while reading, one sentence each; name: of the recording, for sentences about one of several; warnings:
    what is wrong with the streams, one sentence each.
    """

    streams: Mapping[str, Stream] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    name: str = ""
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        ordered = sorted(self.streams.items(), key=lambda item: SENSOR_KINDS.index(item[1].sensor_type))
        object.__setattr__(self, "streams", dict(ordered))

    @classmethod
    def of_streams(cls, *streams: Stream, notes: tuple[str, ...] = (), name: str = "") -> Measurements:
        """Raises RecordingError where a sensor has two streams of one kind."""
        by_key = {s.key: s for s in streams}
        if len(by_key) < len(streams):
            twice = next(s.name for k, s in enumerate(streams) if s.key in [t.key for t in streams[:k]])
            raise RecordingError(f"{name or 'the recording'} has two streams of {twice}; give one.")
        return cls(by_key, notes, name)

    def of(self, kind: type[S]) -> tuple[S, ...]:
        """All streams of one class."""
        return tuple(s for s in self.streams.values() if isinstance(s, kind))

    def only(self, *sensors: str) -> Measurements:
        """The same of `sensors` alone, by name; a name without a stream counts for nothing."""
        return replace(self, streams={k: s for k, s in self.streams.items() if s.name in sensors})

    def without(self, *sensors: str) -> Measurements:
        """The same without these sensors."""
        return replace(self, streams={k: s for k, s in self.streams.items() if s.name not in sensors})

    def with_streams(self, *streams: Stream) -> Measurements:
        """The same with these streams in place of those with the same keys, or beside the others."""
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
        """The first stamp of the body's clock: the IMU's, or without one that of `body`."""
        return self.body.origin_ns if self.imu is None else self.imu.origin_ns

    @property
    def body(self) -> CornerStream | TrackStream | PoseStream:
        """Without an IMU: the stream of the sensor whose frame and clock are the body's. It is the first camera, or the
        first pose sensor where cameras have nothing but feature tracks."""
        follow = bool(self.tracks) and not any(len(c.uv) for c in self.cameras)
        return (*self.poses, *self.tracks)[0] if follow else (*self.cameras, *self.poses)[0]

    def unassociated(self) -> Measurements:
        """The same, of whose LiDARs' points nobody knows on what planes they lie."""
        return self.with_streams(*(x.unassociated() for x in self.lidars))
