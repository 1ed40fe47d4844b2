"""Which recorded images a report shows, and what lies in them: points of LiDARs, and the outline of the target."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple, Protocol, cast

import numpy as np
from scipy.spatial import KDTree

from icalib.data.measurements import Measurements
from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets import Target, target_from_plain
from icalib.result.calibration import Calibration, PointsInImage, RecordingSpan, ReportImage
from icalib.result.path import Clock, CubicPath

MOST_POINTS = 4000  # of a LiDAR in a picture: more hide one another, and each has some ten bytes in the report
MOST_EDGE_POINTS = 800  # the same of points on depth edges, which are drawn larger
EDGE_STEP = 0.1  # share of the distance; a plane shows it between beams 0.2 deg apart if it is grazed by 2 deg
EDGE_NEIGHBOURS, ALIKE = 4, 1.5  # beams on a grid have four at one angle, and the next at 1.41 times that
AROUND, HIDING = 8, 2  # points: on the border of an object that hides another, half of those around are the nearer ones
LEAST_POINTS = 100  # in the picture of a moving rig: fewer show no edge
LONGEST_SCAN_S = 0.2  # of usual LiDARs (5 Hz); points of a picture are taken half of it before and after the image
MOST_DISTANCE = 1e3  # m: farther points are none
OUTLINE_POINTS = 13  # of each side of the target: lenses bend it
TURN_STEP_S = 0.01  # half the interval of the rate of turning; keyframes are some 0.05 s apart
SAME_IMAGE_S = 1e-4  # between the instants of one image in two records


class ScanPoints(Protocol):
    """The part of a stream of scans that is shown: see `LidarStream`."""

    @property
    def stamps_ns(self) -> np.ndarray: ...
    @property
    def start(self) -> np.ndarray: ...
    @property
    def offset_s(self) -> np.ndarray: ...
    @property
    def xyz(self) -> np.ndarray: ...


@dataclass(frozen=True)
class Mount:
    """Place and clock of a sensor: T (4, 4) is T_body_sensor."""

    T: np.ndarray
    clock: Clock

    @classmethod
    def of(cls, c: Calibration, span: RecordingSpan, sensor: str, first: bool = False) -> Mount:
        """Those of the result in the recording `span`; or, with `first`, of the first guess where it has some."""
        T = np.eye(4) if sensor == c.reference else c.T_imu_sensor(sensor)
        clock, guess = Clock.of(c, span, sensor), c.first_guess
        if first:
            T[:3, :3] = guess.get((sensor, "rotation"), T[:3, :3])
            T[:3, 3] = guess.get((sensor, "translation"), T[:3, 3])
            offset = guess.get((sensor, "time_offset"))
            clock = clock if offset is None else Clock.with_offset(c, span, offset)
        return cls(T, clock)


def in_camera(path: CubicPath, world: np.ndarray, camera: Mount, second: float) -> np.ndarray:
    """Points (n, 3) of the world in the frame of the camera at an instant of the result; none if its pose is unknown
    then."""
    R, p, known = path.at(np.array([second]))
    in_body = (world - p[0]) @ R[0]
    return (in_body - camera.T[:3, 3]) @ camera.T[:3, :3] if known[0] else np.zeros((0, 3))


def in_image(c: Calibration, camera: str, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of points (n, 3) in the frame of the camera, by its estimated lens, and which of them (n,) bool are
    in its image. Points behind the camera, or where its model is not valid, are not."""
    sensor = c.rig["sensors"][camera]
    lens = np.concatenate([c.group(camera, name).value for name in ("intrinsics", "distortion")])
    uv, valid = camera_model(sensor["model"]).project(lens, np.ascontiguousarray(points, np.float64))
    inside = (uv >= -0.5) & (uv <= np.array(sensor["resolution"]) - 0.5)
    return uv, valid & inside.all(axis=1)


def cloud_in_image(
    c: Calibration, path: CubicPath, camera: str, mounts: tuple[Mount, Mount], scans: ScanPoints, stamp_ns: int
) -> PointsInImage:
    """Points of a LiDAR in the image of `camera` with this stamp, the farthest first: MOST_POINTS, and MOST_EDGE_POINTS
    on depth edges that are not hidden, at most. mounts: of the camera and of the LiDAR."""
    uv, distance, beams = _points_in_image(c, path, camera, mounts, scans, stamp_ns)
    edge = depth_edges(beams) & ~hidden(uv, distance)
    on_edges = np.flatnonzero(edge)
    some = np.union1d(_spread(len(uv), MOST_POINTS), on_edges[_spread(len(on_edges), MOST_EDGE_POINTS)])
    some = some[np.argsort(-distance[some])]
    return PointsInImage(uv[some], distance[some], edge[some])


def _points_in_image(
    c: Calibration, path: CubicPath, camera: str, mounts: tuple[Mount, Mount], scans: ScanPoints, stamp_ns: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (n, 2) of all points of a LiDAR in an image, their distances (n,) from the camera, and the points (n, 3)
    as measured, in the LiDAR's frame.

    They are the points up to half a scan before and after the image. The trajectory moves each from its own instant to
    that of the image."""
    at_camera, at_lidar = mounts
    second = float(at_camera.clock.seconds(np.array([stamp_ns], np.int64))[0])
    starts = at_lidar.clock.seconds(scans.stamps_ns)
    half = 0.5 * min(LONGEST_SCAN_S, float(np.median(np.diff(starts)))) if len(starts) > 1 else 0.5 * LONGEST_SCAN_S
    first, last = np.searchsorted(starts, [second - LONGEST_SCAN_S - half, second + LONGEST_SCAN_S + half])
    rows = slice(int(scans.start[first]), int(scans.start[last]))
    seconds = np.repeat(starts[first:last], np.diff(scans.start[first : last + 1])) + scans.offset_s[rows]
    near = np.abs(seconds - second) <= half
    R, p, known = path.at(seconds[near])
    beams = scans.xyz[rows][near].astype(np.float64)
    on_body = beams @ at_lidar.T[:3, :3].T + at_lidar.T[:3, 3]
    world = np.einsum("nij,nj->ni", R, on_body) + p
    points = in_camera(path, world[known], at_camera, second)
    uv, inside = in_image(c, camera, points)
    distance = np.linalg.norm(points, axis=1)
    visible = np.flatnonzero(inside & (distance < MOST_DISTANCE))
    return uv[visible], distance[visible], beams[known][visible]


def depth_edges(beams: np.ndarray) -> np.ndarray:
    """(n,) bool: points (n, 3) of a LiDAR, in its frame, beside which it sees something farther by EDGE_STEP of the
    distance, as Levinson and Thrun (2013) find edges along a ring. Beside are the next beams, up to four, at angles
    alike: of sparse rings those of the same ring."""
    if len(beams) <= EDGE_NEIGHBOURS:
        return np.zeros(len(beams), bool)
    reach = np.linalg.norm(beams, axis=1)
    aim = beams / reach[:, None]
    apart, at = map(np.asarray, KDTree(aim).query(aim, EDGE_NEIGHBOURS + 1))
    beside = apart[:, 1:] <= ALIKE * apart[:, 1:2]
    return (beside & (reach[at[:, 1:]] > (1.0 + EDGE_STEP) * reach[:, None])).any(axis=1)


def hidden(uv: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """(n,) bool: which points of a cloud in an image, uv (n, 2) px and distance (n,) m, something nearer hides from the
    camera: HIDING of the points around each are nearer by EDGE_STEP."""
    if len(uv) <= AROUND:
        return np.zeros(len(uv), bool)
    around = np.asarray(KDTree(uv).query(uv, AROUND + 1)[1])[:, 1:]
    return ((1.0 + EDGE_STEP) * distance[around] < distance[:, None]).sum(axis=1) >= HIDING


def _spread(count: int, most: int) -> np.ndarray:
    """Indices of at most `most` of `count`, one at random in each of as many equal parts: even steps would leave out
    whole rings of a LiDAR."""
    n = min(count, most)
    within = np.random.default_rng(0).random(n) if n < count else 0.0
    return ((np.arange(n) + within) * (count / max(n, 1))).astype(np.int64)


def scene_in_worlds(c: Calibration) -> list[tuple[str, np.ndarray]]:
    """Name of the target's scene and R_world_scene (3, 3), by recording. Without an IMU scene and world frame are
    equal. Empty if there is an IMU and the target was never observed."""
    tilts = [(g.sensor, g.value) for g in c.groups if g.name == "tilt"]
    return tilts or ([("board0", np.eye(3))] if c.imu is None else [])


def target_in_image(c: Calibration, path: CubicPath, camera: str, mount: Mount, second: float) -> np.ndarray:
    """(n, 2) px: outlines of the bodies of the target in the image of `camera` at this instant of the result. A row of
    NaN separates two lines; what is outside the image is left out."""
    target, scenes = target_from_plain(c.rig), scene_in_worlds(c)
    if target is None or not scenes:
        return np.zeros((0, 2))
    _, R = scenes[min(int(c.recording_of(np.array([second]))[0]), len(scenes) - 1)]
    world = np.concatenate([_outline(c, target, body) for body in c.bodies or target.bodies]) @ R.T
    points = in_camera(path, world, mount, second)
    uv, inside = in_image(c, camera, np.nan_to_num(points))
    return np.where((inside & np.isfinite(points[:, 0]))[:, None], uv, np.nan)


def _outline(c: Calibration, target: Target, body: str) -> np.ndarray:
    """(n, 3) m: closed outline of the sheet of a body in the frame of the scene; the last row is NaN."""
    low, high = target.outlines[target.bodies.index(body)]
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
    at = np.linspace(0.0, 4.0, 4 * OUTLINE_POINTS - 3)
    flat = np.stack([np.interp(at, np.arange(5.0), corners[:, k]) for k in range(2)] + [np.zeros_like(at)], axis=1)
    T = c.T_scene_body(body) if c.bodies else np.eye(4)
    return np.vstack([flat @ T[:3, :3].T + T[:3, 3], np.full((1, 3), np.nan)])


# Choice of the images.


class _Image(NamedTuple):
    """An image that was kept when it was read: instant in the result [s], recording, stamp [ns], file, JPEG."""

    seconds: float
    recording: int
    stamp_ns: int
    file: str
    jpeg: bytes


def pictures(c: Calibration, lidars: Sequence[str], recordings: Sequence[Measurements]) -> Iterator[ReportImage]:
    """Pictures of each camera of which images were kept when `recordings` were read: the median and the worst image by
    their residuals. With points of each LiDAR: one during the fastest turn, or of stops the median and the worst."""
    path = CubicPath.of(c)
    for camera in c.lenses:
        images = [image for k, m in enumerate(recordings) for image in _kept(c, camera, k, m)]
        if not images:
            continue
        album = _Album(c, path, camera, images)
        yield from (album.picture(*choice) for choice in album.ranked(album.misfits(), "px"))
        for lidar in lidars:
            clouds = [cast(ScanPoints, m.streams[lidar]) for m in recordings]
            if album.of_stops:
                stops = album.ranked(album.distances(lidar), "mm")
                yield from (album.with_points(*choice, lidar, clouds) for choice in stops)
                continue
            turns = (album.with_points(*turn, lidar, clouds) for turn in album.fastest())
            yield from islice((x for x in turns if x.after and len(x.after.uv) >= LEAST_POINTS), 1)


def _kept(c: Calibration, camera: str, recording: int, m: Measurements) -> list[_Image]:
    clock = Clock.of(c, c.recordings[recording], camera)
    kept = {ns: image for s in m.streams.values() if s.name == camera for ns, image in s.pictures.items()}
    seconds = clock.seconds(np.array(list(kept), np.int64)).tolist()
    return [_Image(t, recording, ns, *kept[ns]) for t, ns in zip(seconds, kept, strict=True)]


@dataclass(frozen=True)
class _Album:
    """The n images that were kept of a camera."""

    c: Calibration
    path: CubicPath
    camera: str
    images: Sequence[_Image]

    @property
    def of_stops(self) -> bool:
        """Whether each image is of a stop, with no motion between them."""
        return not self.path.usable.any()

    @property
    def seconds(self) -> np.ndarray:
        """(n,) instants in the result."""
        return np.array([image.seconds for image in self.images])

    def misfits(self) -> np.ndarray:
        """(n,) px: RMS of the residuals of each image per coordinate; NaN without any."""
        r = next((r for r in self.c.image_residuals if r.sensor == self.camera), None)
        if r is None:
            return np.full(len(self.images), np.nan)
        at = nearest(r.seconds, self.seconds)
        return np.where(at >= 0, r.rms_of_images[at], np.nan)

    def distances(self, lidar: str) -> np.ndarray:
        """(n,) mm: RMS distance of the points of a LiDAR from their planes at the instant of each image; NaN without
        any."""
        square, count = np.zeros((2, len(self.images)))
        for r in (r for r in self.c.lidar_residuals if r.sensor == lidar):
            at = nearest(self.seconds, r.seconds)
            np.add.at(count, at[at >= 0], 1.0)
            np.add.at(square, at[at >= 0], (1e3 * r.residual[at >= 0].astype(np.float64)) ** 2)
        return np.sqrt(square / np.where(count > 0.0, count, np.nan))

    def ranked(self, misfit: np.ndarray, unit: str) -> Iterator[tuple[str, _Image]]:
        """Titles and images: the median and the worst of those whose `misfit` (n,) is not NaN."""
        order = np.argsort(misfit)[: int(np.isfinite(misfit).sum())]
        middle, last = order[(len(order) - 1) // 2 :][:1], order[-1:]
        for k, name in {**dict.fromkeys(middle.tolist(), "median"), **dict.fromkeys(last.tolist(), "worst")}.items():
            yield f"the {name} of {len(order)} images, {misfit[k]:.2g} {unit} RMS", self.images[k]

    def fastest(self) -> Iterator[tuple[str, _Image]]:
        """Titles and images, that of the fastest turn first."""
        (R0, _, known), (R1, _, later) = (self.path.at(self.seconds + step) for step in (-TURN_STEP_S, TURN_STEP_S))
        turn = np.linalg.norm(so3.log_many(np.ascontiguousarray(R0.transpose(0, 2, 1) @ R1)), axis=1)
        rate = np.where(known & later, np.rad2deg(turn) / (2.0 * TURN_STEP_S), -1.0)
        for k in np.argsort(-rate)[: int((rate >= 0.0).sum())]:
            yield f"while turning by {rate[k]:.0f} deg/s", self.images[k]

    def picture(self, title: str, image: _Image) -> ReportImage:
        """The image, with the target in it."""
        mount = Mount.of(self.c, self.c.recordings[image.recording], self.camera)
        outline = target_in_image(self.c, self.path, self.camera, mount, image.seconds)
        file = image.file if self.of_stops else ""
        return ReportImage(self.camera, image.seconds, title, image.jpeg, outline, file)

    def with_points(self, title: str, image: _Image, lidar: str, clouds: Sequence[ScanPoints]) -> ReportImage:
        """The image with points of a LiDAR, by the result and by the first guess. clouds: of all recordings."""
        span, scans = self.c.recordings[image.recording], clouds[image.recording]
        now, first = (
            cloud_in_image(self.c, self.path, self.camera, mounts, scans, image.stamp_ns)
            for mounts in (
                (Mount.of(self.c, span, self.camera, guess), Mount.of(self.c, span, lidar, guess))
                for guess in (False, True)
            )
        )
        before = first if self.c.first_guess else None
        return replace(self.picture(title, image), sensor=lidar, after=now, before=before)


def nearest(instants: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """(n,) index of the one of `instants` (m,) at each of `seconds` (n,), at most SAME_IMAGE_S apart; -1: none."""
    if not len(instants):
        return np.full(len(seconds), -1)
    order = np.argsort(instants)
    k = order[np.clip(np.searchsorted(instants[order], seconds + SAME_IMAGE_S) - 1, 0, None)]
    return np.where(np.abs(instants[k] - seconds) <= SAME_IMAGE_S, k, -1)
