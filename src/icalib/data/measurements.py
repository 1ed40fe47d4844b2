"""What sensors measured: frozen arrays with checked shapes, stamped in int64 nanoseconds of each sensor's own clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from icalib.errors import RecordingError

EDGE = 7  # numbers that say how an edge was fitted: see `CornerStream`
NO_EDGES = np.zeros((0, 2, EDGE), dtype=np.float32)
NO_VIEWS = np.zeros(0, dtype=np.int64)


def _check(condition: bool, sentence: str) -> None:
    if not condition:
        raise RecordingError(sentence)


def seconds_since(stamps_ns: np.ndarray, origin_ns: int) -> np.ndarray:
    """Stamps as float64 seconds since `origin_ns`; the difference is taken in integers, so no digit is lost."""
    return (stamps_ns - np.int64(origin_ns)).astype(np.float64) * 1e-9


def which_image(file: str, stamp_ns: int) -> str:
    """Tells an image from others of its stream, in sentences: by its file, or else by its stamp."""
    return file or f"at {stamp_ns} ns"


@dataclass(frozen=True)
class ImuStream:
    """Readings of one IMU.

    stamps_ns (N,) int64, strictly increasing; gyro (N, 3) rad/s; accel (N, 3) m/s^2 (specific force), imu frame.
    """

    name: str
    stamps_ns: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        _check(self.stamps_ns.dtype == np.int64, f"{self.name}: stamps must be int64 nanoseconds.")
        _check(self.gyro.shape == (n, 3), f"{self.name}: gyro must have shape ({n}, 3), not {self.gyro.shape}.")
        _check(self.accel.shape == (n, 3), f"{self.name}: accel must have shape ({n}, 3), not {self.accel.shape}.")

    @property
    def origin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        """(N,) seconds since this clock's own first stamp."""
        return seconds_since(self.stamps_ns, self.origin_ns)


@dataclass(frozen=True)
class CornerStream:
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

    name: str
    stamps_ns: np.ndarray
    start: np.ndarray
    point: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray = field(default_factory=lambda: np.zeros(0), kw_only=True)
    edges: np.ndarray = field(default_factory=lambda: NO_EDGES, kw_only=True)
    joins_ns: tuple[int, ...] = field(default=(), kw_only=True)  # the first stamp of each further recording joined
    files: Mapping[int, str] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        n, m = len(self.uv), len(self.stamps_ns)
        _check(self.stamps_ns.dtype == np.int64, f"{self.name}: stamps must be int64 nanoseconds.")
        _check(self.start.shape == (m + 1,), f"{self.name}: start must have shape ({m + 1},), not {self.start.shape}.")
        _check(int(self.start[-1]) == n, f"{self.name}: start must end at the number of corners, {n}.")
        _check(self.point.shape == (n,), f"{self.name}: point must have shape ({n},), not {self.point.shape}.")
        _check(self.uv.shape == (n, 2), f"{self.name}: uv must have shape ({n}, 2), not {self.uv.shape}.")
        stated = self.sigma.shape in ((0,), (n,)) and bool((self.sigma > 0.0).all())
        _check(stated, f"{self.name}: sigma must be positive, one for each of the {n} corners or none.")
        fits = self.edges.shape in (NO_EDGES.shape, (n, 2, EDGE))
        _check(fits, f"{self.name}: edges must have shape ({n}, 2, {EDGE}), not {self.edges.shape}.")

    def of_rows(self, rows: np.ndarray, stamps_ns: np.ndarray, count: np.ndarray) -> CornerStream:
        """The corners of `rows` (indices or a mask), grouped into images at stamps_ns (M,) with count (M,) each."""
        start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        sigma, edges = (x[rows] if len(x) else x for x in (self.sigma, self.edges))
        point, uv, files = self.point[rows], self.uv[rows], self.files
        return CornerStream(self.name, stamps_ns, start, point, uv, sigma=sigma, edges=edges, files=files)

    def which(self, stamp_ns: int) -> str:
        """Tells the image with this stamp from others, in sentences."""
        return which_image(self.files.get(stamp_ns, ""), stamp_ns)

    @property
    def relative_sigma(self) -> np.ndarray:
        """(N,) each corner's standard deviation over that of the median corner; ones where the detector states none."""
        return self.sigma / np.median(self.sigma) if len(self.sigma) else np.ones(len(self.uv))

    @property
    def origin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        """(M,) seconds since this clock's own first stamp."""
        return seconds_since(self.stamps_ns, self.origin_ns)

    @property
    def image(self) -> np.ndarray:
        """(N,) the image that each corner belongs to."""
        return np.repeat(np.arange(len(self.stamps_ns)), np.diff(self.start))


def _check_groups(name: str, stamps_ns: np.ndarray, start: np.ndarray, what: str, counts: dict[str, int]) -> None:
    """Stamps (M,) int64, start (M + 1,) from 0 upwards to the length of every column."""
    _check(stamps_ns.dtype == np.int64, f"{name}: stamps must be int64 nanoseconds.")
    m = len(stamps_ns)
    _check(start.shape == (m + 1,), f"{name}: start must have shape ({m + 1},), not {start.shape}.")
    n = int(start[-1])
    _check(int(start[0]) == 0 and bool((np.diff(start) >= 0).all()), f"{name}: start must run upwards from 0.")
    for column, count in counts.items():
        _check(count == n, f"{name}: {column} must have a row for each of the {n} {what}, not {count}.")


@dataclass(frozen=True)
class TrackStream:
    """Points of the scene that one camera followed, image by image, as a front end reports them.

    stamps_ns (M,) int64, one per image, strictly increasing; start (M + 1,) int64, observations of image i are
    start[i]:start[i+1]; feature (N,) int64, the same number is the same point of the scene, in all cameras; uv (N, 2)
    pixels, (0, 0) is the centre of the top-left pixel; views (N,) int64, how many images the tracker had seen the
    feature in before, (0,) where it does not say; spread (N,) px^2, second moment of the patch that was aligned, along
    each axis, as the alignment weighs its points, (0,) where it does not say.
    """

    name: str
    stamps_ns: np.ndarray
    start: np.ndarray
    feature: np.ndarray
    uv: np.ndarray
    views: np.ndarray = field(default_factory=lambda: NO_VIEWS, kw_only=True)
    spread: np.ndarray = field(default_factory=lambda: np.zeros(0), kw_only=True)

    def __post_init__(self) -> None:
        counts = {"feature": len(self.feature), "uv": len(self.uv)}
        counts |= {name: n for name in ("views", "spread") if (n := len(getattr(self, name)))}
        _check_groups(self.name, self.stamps_ns, self.start, "observations", counts)
        _check(self.feature.dtype == np.int64, f"{self.name}: feature must be int64.")
        _check(self.uv.shape[1:] == (2,), f"{self.name}: uv must have shape (N, 2), not {self.uv.shape}.")

    def which(self, stamp_ns: int) -> str:
        """Tells the image with this stamp from others, in sentences."""
        return which_image("", stamp_ns)

    @property
    def origin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        """(M,) seconds since this clock's own first stamp."""
        return seconds_since(self.stamps_ns, self.origin_ns)

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
class LidarStream:
    """Points of one LiDAR, scan by scan.

    stamps_ns (S,) int64, one per scan, strictly increasing; start (S + 1,) int64, points of scan i are
    start[i]:start[i+1]; offset_s (N,) float32, instant of each point from its scan's stamp; xyz (N, 3) float32 [m] in
    the sensor's frame at the point's own instant; plane (N,) int32, the plane that it is known to lie on, -1: unknown.
    """

    name: str
    stamps_ns: np.ndarray
    start: np.ndarray
    offset_s: np.ndarray
    xyz: np.ndarray
    plane: np.ndarray
    joins_ns: tuple[int, ...] = field(default=(), kw_only=True)  # the first stamp of each further recording joined

    def __post_init__(self) -> None:
        counts = {"offset_s": len(self.offset_s), "xyz": len(self.xyz), "plane": len(self.plane)}
        _check_groups(self.name, self.stamps_ns, self.start, "points", counts)
        _check(self.xyz.shape[1:] == (3,), f"{self.name}: xyz must have shape (N, 3), not {self.xyz.shape}.")
        for column, array in (("offset_s", self.offset_s), ("xyz", self.xyz)):
            _check(array.dtype == np.float32, f"{self.name}: {column} must be float32.")
        _check(self.plane.dtype == np.int32, f"{self.name}: plane must be int32.")

    @property
    def origin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        """(S,) seconds since this clock's own first stamp."""
        return seconds_since(self.stamps_ns, self.origin_ns)

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
class WheelStream:
    """What wheels, or the driver of a vehicle, report of its motion.

    stamps_ns (N,) int64, strictly increasing; rate (N, 2), by kind: "pair", rates of the left and the right wheel
    [rad/s], positive forwards; "steered", rate of the driven wheel [rad/s] and steering angle [rad], positive to the
    left; "twist", forward speed [m/s] and yaw rate [rad/s], positive to the left. sampling "interval-mean":
    reading i is the mean over the period from stamp i-1 to stamp i, so rate x period is the angle turned (what a
    difference of encoder counts gives; the first reading's period began one unknown stamp earlier). "instantaneous":
    the rate at the stamp, as steering angles always are.
    """

    name: str
    stamps_ns: np.ndarray
    rate: np.ndarray
    sampling: Literal["interval-mean", "instantaneous"] = "interval-mean"
    kind: Literal["pair", "steered", "twist"] = "pair"
    joins_ns: tuple[int, ...] = field(default=(), kw_only=True)  # the first stamp of each further recording joined

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        _check(self.stamps_ns.dtype == np.int64, f"{self.name}: stamps must be int64 nanoseconds.")
        _check(self.rate.shape == (n, 2), f"{self.name}: rate must have shape ({n}, 2), not {self.rate.shape}.")

    @property
    def origin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        """(N,) seconds since this clock's own first stamp."""
        return seconds_since(self.stamps_ns, self.origin_ns)


@dataclass(frozen=True)
class WheelPoses:
    """Relative planar poses of a wheel frame between consecutive instants, the paper's z_W of (27).

    stamps_ns (K + 1,) int64, strictly increasing; pose (K, 3) yaw [rad], x, y [m] of the wheel frame at stamp k+1 in
    the wheel frame at stamp k; covariance (K, 3, 3) of the same.
    """

    name: str
    stamps_ns: np.ndarray
    pose: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        k = len(self.stamps_ns) - 1
        _check(self.stamps_ns.dtype == np.int64, f"{self.name}: stamps must be int64 nanoseconds.")
        _check(self.pose.shape == (k, 3), f"{self.name}: pose must have shape ({k}, 3), not {self.pose.shape}.")
        shape = self.covariance.shape
        _check(shape == (k, 3, 3), f"{self.name}: covariance must have shape ({k}, 3, 3), not {shape}.")

    @property
    def origin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        """(K + 1,) seconds since this clock's own first stamp."""
        return seconds_since(self.stamps_ns, self.origin_ns)


@dataclass(frozen=True)
class PoseStream:
    """Where a sensor said that it was: its poses in a frame that stands still, or nearly so.

    stamps_ns (N,) int64, strictly increasing; rotation (N, 3, 3) R_frame_sensor; position (N, 3) p_frame_sensor [m].
    """

    name: str
    stamps_ns: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    joins_ns: tuple[int, ...] = field(default=(), kw_only=True)  # the first stamp of each further recording joined

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        _check(self.stamps_ns.dtype == np.int64, f"{self.name}: stamps must be int64 nanoseconds.")
        shape = self.rotation.shape
        _check(shape == (n, 3, 3), f"{self.name}: rotation must have shape ({n}, 3, 3), not {shape}.")
        shape = self.position.shape
        _check(shape == (n, 3), f"{self.name}: position must have shape ({n}, 3), not {shape}.")

    @property
    def origin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        """(N,) seconds since this clock's own first stamp."""
        return seconds_since(self.stamps_ns, self.origin_ns)


Stream = CornerStream | LidarStream | WheelStream | WheelPoses | PoseStream


@dataclass(frozen=True)
class Measurements:
    """Everything one recording holds that the rig asks for."""

    imu: ImuStream | None
    cameras: tuple[CornerStream, ...]
    notes: tuple[str, ...] = ()  # what was dropped or repaired while reading, one sentence each
    name: str = ""  # of the recording, for sentences about one of several
    tracks: tuple[TrackStream, ...] = ()
    lidars: tuple[LidarStream, ...] = ()
    wheels: tuple[WheelStream | WheelPoses, ...] = ()
    poses: tuple[PoseStream, ...] = ()
    warnings: tuple[str, ...] = ()  # what was found to be wrong with them, one sentence each

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
        return replace(self, lidars=tuple(x.unassociated() for x in self.lidars))
