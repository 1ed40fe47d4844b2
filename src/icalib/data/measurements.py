"""What sensors measured: frozen arrays with checked shapes, stamped in int64 nanoseconds of each sensor's own clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np

from icalib.errors import RecordingError
from icalib.sensors import SENSOR_KINDS
from icalib.sensors.stream import S, Stream, check, check_groups, far_origin, which_image

EDGE = 7  # numbers that say how an edge was fitted: see `CornerStream`
NO_EDGES = np.zeros((0, 2, EDGE), dtype=np.float32)
NO_VIEWS = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class ImuStream(Stream):
    """Readings of one IMU.

    stamps_ns (N,) int64, strictly increasing; gyro (N, 3) rad/s; accel (N, 3) m/s^2 (specific force), imu frame.
    """

    sensor_type: ClassVar[str] = "imu"
    gyro: np.ndarray
    accel: np.ndarray

    def __post_init__(self) -> None:
        super().__post_init__()
        n = len(self.stamps_ns)
        check(self.gyro.shape == (n, 3), f"{self.name}: gyro must have shape ({n}, 3), not {self.gyro.shape}.")
        check(self.accel.shape == (n, 3), f"{self.name}: accel must have shape ({n}, 3), not {self.accel.shape}.")


@dataclass(frozen=True)
class CornerStream(Stream):
    """Target corners that one camera saw, image by image.

    stamps_ns (M,) int64, one per image, strictly increasing; start (M + 1,) int64, corners of image i are
    start[i]:start[i+1]; point (N,) int64, index into the target's points; uv (N, 2) pixels, (0, 0) is the
    centre of the top-left pixel; sigma (N,) pixels, the detector's standard deviation of each corner per axis up to a
    factor common to all, (0,) where it states none.

    edges (N, 2, EDGE) float32, (0, 2, EDGE) where it states none: the two edges that meet in each corner, as they were
    fitted. Columns: the piece of the edge that was used, from (2,) and to (2,) px beside the corner; gain (2,) px^2, by
    how much the corner moves where the piece's curvature is larger than the fitted one; that curvature [1 / px]. The
    curvature is positive where the piece, as u is to the right and v down, turns to the left on its way.

    files: names of the files that images come from, by stamp, "" for those of no file; also of images without corners.
    """

    sensor_type: ClassVar[str] = "camera"
    start: np.ndarray
    point: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray = field(default_factory=lambda: np.zeros(0), kw_only=True)
    edges: np.ndarray = field(default_factory=lambda: NO_EDGES, kw_only=True)
    files: Mapping[int, str] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        n, m = len(self.uv), len(self.stamps_ns)
        check(self.start.shape == (m + 1,), f"{self.name}: start must have shape ({m + 1},), not {self.start.shape}.")
        check(int(self.start[-1]) == n, f"{self.name}: start must end at the number of corners, {n}.")
        check(self.point.shape == (n,), f"{self.name}: point must have shape ({n},), not {self.point.shape}.")
        check(self.uv.shape == (n, 2), f"{self.name}: uv must have shape ({n}, 2), not {self.uv.shape}.")
        stated = self.sigma.shape in ((0,), (n,)) and bool((self.sigma > 0.0).all())
        check(stated, f"{self.name}: sigma must be positive, one for each of the {n} corners or none.")
        fits = self.edges.shape in (NO_EDGES.shape, (n, 2, EDGE))
        check(fits, f"{self.name}: edges must have shape ({n}, 2, {EDGE}), not {self.edges.shape}.")

    def of_rows(self, rows: np.ndarray, stamps_ns: np.ndarray, count: np.ndarray) -> CornerStream:
        """The corners of `rows` (indices or a mask), grouped into images at stamps_ns (M,) with count (M,) each."""
        start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        sigma, edges = (x[rows] if len(x) else x for x in (self.sigma, self.edges))
        point, uv, files = self.point[rows], self.uv[rows], self.files
        return CornerStream(self.name, stamps_ns, start, point, uv, sigma=sigma, edges=edges, files=files)

    @classmethod
    def joined(cls, streams: Sequence[Any], shifts_ns: Sequence[int] | None = None) -> Self:
        parts = zip(streams, shifts_ns or [0] * len(streams), strict=True)
        files = {stamp + shift: file for stream, shift in parts for stamp, file in stream.files.items()}
        return replace(super().joined(streams, shifts_ns), files=files)

    def which(self, stamp_ns: int) -> str:
        """Tells the image with this stamp from others, in sentences."""
        return which_image(self.files.get(stamp_ns, ""), stamp_ns)

    @property
    def relative_sigma(self) -> np.ndarray:
        """(N,) each corner's standard deviation over that of the median corner; ones where the detector states none."""
        return self.sigma / np.median(self.sigma) if len(self.sigma) else np.ones(len(self.uv))

    @property
    def image(self) -> np.ndarray:
        """(N,) the image that each corner belongs to."""
        return np.repeat(np.arange(len(self.stamps_ns)), np.diff(self.start))


@dataclass(frozen=True)
class TrackStream(Stream):
    """Points of the scene that one camera followed, image by image, as a front end reports them.

    stamps_ns (M,) int64, one per image, strictly increasing; start (M + 1,) int64, observations of image i are
    start[i]:start[i+1]; feature (N,) int64, the same number is the same point of the scene, in all cameras; uv (N, 2)
    pixels, (0, 0) is the centre of the top-left pixel; views (N,) int64, how many images the tracker had seen the
    feature in before, (0,) where it does not say; spread (N,) px^2, second moment of the patch that was aligned, along
    each axis, as the alignment weighs its points, (0,) where it does not say.
    """

    sensor_type: ClassVar[str] = "camera"
    start: np.ndarray
    feature: np.ndarray
    uv: np.ndarray
    views: np.ndarray = field(default_factory=lambda: NO_VIEWS, kw_only=True)
    spread: np.ndarray = field(default_factory=lambda: np.zeros(0), kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = {"feature": len(self.feature), "uv": len(self.uv)}
        counts |= {name: n for name in ("views", "spread") if (n := len(getattr(self, name)))}
        check_groups(self.name, self.stamps_ns, self.start, "observations", counts)
        check(self.feature.dtype == np.int64, f"{self.name}: feature must be int64.")
        check(self.uv.shape[1:] == (2,), f"{self.name}: uv must have shape (N, 2), not {self.uv.shape}.")

    @property
    def key(self) -> str:
        """A camera may have corners as well."""
        return f"{self.name}/tracks"

    @classmethod
    def disjoint(cls, recordings: Sequence[Sequence[Any]]) -> Sequence[Sequence[Self]]:
        """Features numbered anew, so that no two recordings share one; cameras of one recording still do."""
        numbered, first = [], 0
        for streams in recordings:
            least = min((int(t.feature.min(initial=0)) for t in streams), default=0)
            most = max((int(t.feature.max(initial=-1)) for t in streams), default=-1)
            numbered.append([replace(t, feature=t.feature - least + first) for t in streams])
            first += 1 + most - least
        return numbered

    def which(self, stamp_ns: int) -> str:
        """Tells the image with this stamp from others, in sentences."""
        return which_image("", stamp_ns)

    @property
    def image(self) -> np.ndarray:
        """(N,) the image that each observation belongs to."""
        return np.repeat(np.arange(len(self.stamps_ns)), np.diff(self.start))


def shared_rows(start: np.ndarray, feature: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the features that images i and j share, as i and as j saw them; start (M + 1,), feature (N,) as in
    `TrackStream`."""
    own, other = feature[start[i] : start[i + 1]], feature[start[j] : start[j + 1]]
    _, p, q = np.intersect1d(own, other, return_indices=True)
    return p + start[i], q + start[j]


@dataclass(frozen=True)
class LidarStream(Stream):
    """Points of one LiDAR, scan by scan.

    stamps_ns (S,) int64, one per scan, strictly increasing; start (S + 1,) int64, points of scan i are
    start[i]:start[i+1]; offset_s (N,) float32, instant of each point from its scan's stamp; xyz (N, 3) float32 [m] in
    the sensor's frame at the point's own instant; plane (N,) int32, the plane that it is known to lie on, -1: unknown.
    """

    sensor_type: ClassVar[str] = "lidar"
    start: np.ndarray
    offset_s: np.ndarray
    xyz: np.ndarray
    plane: np.ndarray

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = {"offset_s": len(self.offset_s), "xyz": len(self.xyz), "plane": len(self.plane)}
        check_groups(self.name, self.stamps_ns, self.start, "points", counts)
        check(self.xyz.shape[1:] == (3,), f"{self.name}: xyz must have shape (N, 3), not {self.xyz.shape}.")
        for column, array in (("offset_s", self.offset_s), ("xyz", self.xyz)):
            check(array.dtype == np.float32, f"{self.name}: {column} must be float32.")
        check(self.plane.dtype == np.int32, f"{self.name}: plane must be int32.")

    def some(self, kept: np.ndarray) -> LidarStream:
        """The points in `kept` (N,) bool; all scans stay, if empty."""
        if kept.all():
            return self
        start = np.concatenate([[0], np.cumsum(kept)])[self.start].astype(np.int64)
        columns = {name: getattr(self, name)[kept] for name in ("offset_s", "xyz", "plane")}
        return replace(self, start=start, **columns)

    def unassociated(self) -> LidarStream:
        """The same points, of which nobody knows on what planes they lie."""
        return replace(self, plane=np.full(len(self.plane), -1, np.int32))


@dataclass(frozen=True)
class WheelStream(Stream):
    """What wheels, or the driver of a vehicle, report of its motion.

    stamps_ns (N,) int64, strictly increasing; rate (N, 2), by kind: "pair", rates of the left and the right wheel
    [rad/s], positive forwards; "steered", rate of the driven wheel [rad/s] and steering angle [rad], positive to the
    left; "twist", forward speed [m/s] and yaw rate [rad/s], positive to the left. sampling "interval-mean":
    reading i is the mean over the period from stamp i-1 to stamp i, so rate x period is the angle turned (what a
    difference of encoder counts gives; the first reading's period began one unknown stamp earlier). "instantaneous":
    the rate at the stamp, as steering angles always are.
    """

    sensor_type: ClassVar[str] = "wheels"
    rate: np.ndarray
    sampling: Literal["interval-mean", "instantaneous"] = "interval-mean"
    kind: Literal["pair", "steered", "twist"] = "pair"

    def __post_init__(self) -> None:
        super().__post_init__()
        n = len(self.stamps_ns)
        check(self.rate.shape == (n, 2), f"{self.name}: rate must have shape ({n}, 2), not {self.rate.shape}.")


@dataclass(frozen=True)
class WheelPoses(Stream):
    """Relative planar poses of a wheel frame between consecutive instants, the paper's z_W of (27).

    stamps_ns (K + 1,) int64, strictly increasing; pose (K, 3) yaw [rad], x, y [m] of the wheel frame at stamp k+1 in
    the wheel frame at stamp k; covariance (K, 3, 3) of the same.
    """

    sensor_type: ClassVar[str] = "wheels"
    pose: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        super().__post_init__()
        k = len(self.stamps_ns) - 1
        check(self.pose.shape == (k, 3), f"{self.name}: pose must have shape ({k}, 3), not {self.pose.shape}.")
        shape = self.covariance.shape
        check(shape == (k, 3, 3), f"{self.name}: covariance must have shape ({k}, 3, 3), not {shape}.")

    @classmethod
    def joined(cls, streams: Sequence[Any], shifts_ns: Sequence[int] | None = None) -> Self:
        """Raises RecordingError: there is no relative pose between two recordings."""
        del shifts_ns
        raise RecordingError(
            f"{streams[0].name} measures relative poses, and there is none between two recordings; give one "
            "recording, or wheels that measure rates, angles or ticks."
        )


@dataclass(frozen=True)
class PoseStream(Stream):
    """Where a sensor said that it was: its poses in a frame that stands still, or nearly so.

    stamps_ns (N,) int64, strictly increasing; rotation (N, 3, 3) R_frame_sensor; position (N, 3) p_frame_sensor [m].
    """

    sensor_type: ClassVar[str] = "pose"
    rotation: np.ndarray
    position: np.ndarray

    def __post_init__(self) -> None:
        super().__post_init__()
        n = len(self.stamps_ns)
        shape = self.rotation.shape
        check(shape == (n, 3, 3), f"{self.name}: rotation must have shape ({n}, 3, 3), not {shape}.")
        shape = self.position.shape
        check(shape == (n, 3), f"{self.name}: position must have shape ({n}, 3), not {shape}.")

    def near_origin(self) -> tuple[Self, tuple[str, ...]]:
        origin = far_origin(self.position)
        if origin is None:
            return self, ()
        x, y, z = origin
        where = f"({x:.0f}, {y:.0f}, {z:.0f}) m of its frame, whose origin is far away"
        note = f"{self.name}: positions are relative to {where}."
        return replace(self, position=self.position - origin), (note,)


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
