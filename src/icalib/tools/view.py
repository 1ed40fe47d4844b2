"""A 3D view of a result and its recording in Rerun.

Shows a stored result and its recording in Rerun.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from icalib.base.extras import load_rerun
from icalib.base.files import staged
from icalib.data.recordings import DamagedImageError, Recording, decode, open_recording
from icalib.errors import CalibrationError, RecordingError
from icalib.geometry.targets import target_from_plain
from icalib.kinds import presenters
from icalib.report import rig_figures
from icalib.report.figures import AXIS_COLORS, COLORS, REJECTED, curves
from icalib.report.pictures import NEAR_TO_FAR, ends_of, shades
from icalib.report.rig_figures import SIGMAS, VERDICT_COLORS, ellipsoids, magnification
from icalib.result import Calibration, RecordingSpan, load_calibration
from icalib.result.path import Clock, CubicPath
from icalib.result.pictures import Mount, ScanPoints, cloud_in_image, scene_in_worlds, target_in_image
from icalib.result.quantities import rows
from icalib.rig import Camera, ImuSensor, Lidar, Rig
from icalib.rig.file import rig_from_dict
from icalib.sensors.camera.read import image_sources, sees
from icalib.sensors.imu.read import time_series
from icalib.sensors.lidar.read import scans
from icalib.sensors.lidar.stream import LidarStream

__all__ = ["view"]


def view(
    result: str | Path,
    recording: str | Path | None = None,
    save: str | Path | None = None,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> list[str]:
    """Shows the result of a calibration, and its recording, in Rerun's viewer. With `save`, a file for the viewer is
    written instead. Returns sentences on data that are not shown.

    result: the folder of a result, or the result.json in it. Raises CalibrationError if there is no result, the
    recording is not that of the result, the file cannot be written, or Rerun is not installed.
    """
    rr, folder = load_rerun(), Path(result)
    folder = folder.parent if folder.name == "result.json" else folder
    c = load_calibration(folder)
    recorded = None if recording is None else _recorded(c, folder, Path(recording))
    layout = blueprint(rr, c, recorded is not None)
    with opened(rr, layout, None if save is None else Path(save)) as stream:
        _log_result(stream, c)
        notes = [] if recorded is None else recorded.log(stream, progress)
        stream.still("summary", rr.TextDocument(summary(c, notes), media_type=rr.MediaType.MARKDOWN))
    return notes


def _recorded(c: Calibration, folder: Path, recording: Path) -> Recorded:
    opened_recording = open_recording(recording)
    rig = rig_from_dict(c.rig, str(folder / "result.json"))
    opened_recording.use_layouts(tuple(rig.sensors.values()))
    recorded = Recorded(c, rig, opened_recording, span_of(c, recording), recording)
    recorded.check()
    return recorded


def _log_result(stream: RerunStream, c: Calibration) -> None:
    for log in (log_rig, log_uncertainty, log_motion, log_target, log_planes, log_residuals, log_states):
        log(stream, c)


def summary(c: Calibration, notes: list[str]) -> str:
    """Status, warnings and parameters of the result, in Markdown."""
    sentences = [("Unobservable", c.unobservable), ("Warning", c.warnings), ("Shown", notes)]
    if c.mounted:
        sentences.append(("Ellipsoids", [f"{SIGMAS:g} sigma of each position, {magnification(c):g} times as large."]))
    listed = [f"- {title}: {sentence}" for title, of in sentences for sentence in of]
    table = ["| sensor | parameter | value | std | unit | verdict |", "|---|---|---|---|---|---|"]
    table += [f"| {r.sensor} | {r.name} | {r.value} | {r.std} | {r.unit} | {r.verdict} |" for r in rows(c)]
    return "\n".join([f"**{c.status}**", "", *listed, "", *table])


# Sends data to Rerun: to its viewer, or to a file that is written atomically.
#
# Colours from values, for points.

TIMELINE = "imu clock"
_PATIENCE_S = 30.0  # time limit for the viewer to receive all data


@dataclass(frozen=True)
class RerunStream:
    """A Rerun recording. rr: the rerun package; rec: its stream. Time-dependent data are on one timeline, in seconds of
    the result's clock."""

    rr: Any
    rec: Any

    def still(self, entity: str, *what: Any) -> None:
        """Sends archetypes that are valid at all times."""
        self.rec.log(entity, *what, static=True, strict=True)

    def at(self, entity: str, seconds: float, *what: Any) -> None:
        """Sends archetypes that are valid from an instant on."""
        self.rec.set_time(TIMELINE, duration=_rounded(np.array([seconds]))[0])
        self.rec.log(entity, *what, strict=True)

    def over(self, entity: str, seconds: np.ndarray, columns: Any) -> None:
        """Sends columns with a row for each of the seconds (n,)."""
        if len(seconds):
            index = self.rr.TimeColumn(TIMELINE, duration=_rounded(seconds))
            self.rec.send_columns(entity, [index], columns, strict=True)


@contextlib.contextmanager
def opened(rr: Any, blueprint: Any, save: Path | None) -> Iterator[RerunStream]:
    """Context with a stream to the file `save`, which replaces an old file at the end; save None: to a viewer, which is
    started. Raises CalibrationError if the file cannot be written, or there is no viewer."""
    rec = rr.RecordingStream("icalib")
    rec.set_log_time_enabled(False)
    if save is None:
        with _sentence("Rerun's viewer cannot be started or does not answer", "write a file by --save"):
            rec.spawn(default_blueprint=blueprint)
        yield RerunStream(rr, rec)
        with _sentence("Rerun's viewer cannot be started or does not answer", "write a file by --save"):
            rec.flush(timeout_sec=_PATIENCE_S)
        return
    try:
        with contextlib.ExitStack() as stack:
            with _sentence(f"{save} cannot be written", "choose another place"):
                if save.is_dir():
                    raise IsADirectoryError(0, "it is a folder")
                part = stack.enter_context(staged(save.parent)) / save.name
                rec.save(part, default_blueprint=blueprint)
            yield RerunStream(rr, rec)
            with _sentence(f"{save} cannot be written", "choose another place"):
                rec.flush()
                rec.disconnect()
                os.replace(part, save)
    finally:
        rec.disconnect()


@contextlib.contextmanager
def _sentence(what: str, advice: str) -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error).splitlines()[0]
        raise CalibrationError(f"{what} ({reason}); {advice}.") from error


def _rounded(seconds: np.ndarray) -> np.ndarray:
    """Seconds (n,) as whole nanoseconds, Rerun's unit of time."""
    return np.rint(1e9 * seconds).astype(np.int64).astype("timedelta64[ns]")


# Five colours of matplotlib's viridis, whose brightness increases steadily, also for colour-blind people.
_STOPS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], np.float64)


def by_value(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """(N, 3) uint8 RGB of values (N,): dark at `low` and below, bright at `high` and above."""
    share = np.clip((values - low) / max(high - low, np.finfo(float).tiny), 0.0, 1.0)
    at = np.linspace(0.0, 1.0, len(_STOPS))
    return np.stack([np.interp(share, at, channel) for channel in _STOPS.T], axis=1).round().astype(np.uint8)


def rgb(*colors: str) -> np.ndarray:
    """(n, 3) uint8 RGB of colours in HTML notation, "#rrggbb"."""
    return np.array([list(bytes.fromhex(color[1:])) for color in colors], np.uint8)


# Shows the recording of a result: IMU readings, images and scans, placed by the calibration.
#
# Curves over time: residuals, velocity and biases.

MOST_READINGS = 100_000  # shown of an IMU
MOST_IMAGES = 600  # shown of a camera
MOST_SCANS, MOST_POINTS = 400, 15_000  # shown of a sensor, and of a scan
JPEG_QUALITY = 75
_HEIGHTS = (2.0, 98.0)  # percentiles of the height between which colours change

Progress = Callable[[str, float], None]


def span_of(c: Calibration, recording: Path) -> RecordingSpan:
    """The span of the result's recording at a path. Raises CalibrationError if it is no recording of the result."""
    if not c.recordings:
        raise CalibrationError("the result does not tell the time of its recording; calibrate again to see both.")
    path = recording.resolve()
    named = [span for span in c.recordings if span.name in (path.name, str(path))]
    if len(c.recordings) == 1 or named:
        return (named or c.recordings)[0]
    names = ", ".join(span.name for span in c.recordings)
    raise CalibrationError(f"{recording} is not a recording of the result, which has {names}; give one of them.")


@dataclass(frozen=True)
class Recorded:
    """One recording of a result, opened. where: its path. All methods may raise RecordingError, one sentence."""

    calibration: Calibration
    rig: Rig
    recording: Recording
    span: RecordingSpan
    where: Path

    def check(self) -> None:
        """Raises RecordingError if a sensor of the result is not in the recording."""
        for sensor in self.rig.sensors.values():
            if not isinstance(sensor, Camera) or not sensor.tracks_points or sees(self.recording, sensor):
                self.recording.where(sensor)

    def log(self, s: RerunStream, progress: Progress) -> list[str]:
        """Sends all data to Rerun, and returns sentences on data that were left out."""
        sensors = self.rig.sensors.values()
        topics = dict(image_sources(self.recording, self.rig))
        work = [
            (sensor.name, lambda x=sensor: self._readings(s, x)) for sensor in sensors if isinstance(sensor, ImuSensor)
        ]
        work += [(sensor.name, lambda x=sensor: self._scans(s, x)) for sensor in sensors if isinstance(sensor, Lidar)]
        work += [(name, lambda n=name, t=topic: self._images(s, n, t)) for name, topic in topics.items()]
        without_images = [x.name for x in sensors if x.lens and x.name not in topics]
        notes = [f"{name}: the recording holds no images of it." for name in without_images]
        for k, (name, do) in enumerate(work):
            progress(f"showing {name}", k / len(work))
            notes += do()
        return notes

    def _clock(self, sensor: str) -> Clock:
        return Clock.of(self.calibration, self.span, sensor)

    def _during(self, sensor: str, seconds: np.ndarray) -> np.ndarray:
        """Indices of the `seconds` within the span of the result. Raises RecordingError if there are none."""
        inside = np.flatnonzero(self._clock(sensor).within(seconds))
        if not len(inside):
            raise RecordingError(
                f"{self.where} holds no data of {sensor} from the time of the result; give the recording "
                f"{self.span.name}, from which the result was computed."
            )
        return inside

    def _readings(self, s: RerunStream, sensor: ImuSensor) -> list[str]:
        stamps_ns, readings = time_series(self.recording, sensor)
        seconds = self._clock(sensor.name).seconds(stamps_ns)
        inside = self._during(sensor.name, seconds)
        keep = inside[:: _stride(len(inside), MOST_READINGS)]
        keep = keep[np.argsort(seconds[keep], kind="stable")]
        for name, values in readings.items():
            log_lines(s, f"readings/{sensor.name}/{name}", seconds[keep], values[keep], "xyz")
        return _thinned(sensor.name, len(inside), MOST_READINGS, "readings")

    def _images(self, s: RerunStream, name: str, topic: str) -> list[str]:
        """Sends images of the camera `name` one by one; images that are left out are not decoded."""
        seconds = self._clock(name).seconds(self.recording.stamps(topic))
        count = len(self._during(name, np.sort(seconds)))
        clock, damaged, show_points = self._clock(name), 0, self._points_in(s, name)
        within = (p for p in self.recording.payloads(topic) if clock.within(_instant(clock, p.stamp_ns))[0])
        for payload in islice(within, 0, None, _stride(count, MOST_IMAGES)):
            try:
                image = s.rr.Image(decode(payload), "L").compress(jpeg_quality=JPEG_QUALITY)
            except DamagedImageError:
                damaged += 1
                continue
            second = float(_instant(clock, payload.stamp_ns)[0])
            s.at(f"{place(self.calibration, name)}/image", second, image)
            show_points(payload.stamp_ns, second)
        notes = [f"{name}: {damaged} damaged images are not shown."] if damaged else []
        return notes + _thinned(name, count, MOST_IMAGES, "images")

    def _points_in(self, s: RerunStream, camera: str) -> Callable[[int, float], None]:
        """Function that sends the points of all LiDARs and the outline of the target in the image of `camera` with a
        stamp [ns], at a time of the result [s]. Colours are those of the report, with one scale for all images."""
        c, span, path = self.calibration, self.span, CubicPath.of(self.calibration)
        at_camera, entity = Mount.of(c, span, camera), f"{place(c, camera)}/image"
        mounts = {lidar: (at_camera, Mount.of(c, span, lidar)) for lidar in self.clouds}
        ends: dict[str, tuple[float, float]] = {}

        def show(stamp_ns: int, second: float) -> None:
            for lidar, scans_of in self.clouds.items():
                points = cloud_in_image(c, path, camera, mounts[lidar], scans_of, stamp_ns)
                if len(points.uv):
                    ends.setdefault(lidar, ends_of(points))
                colors = rgb(*NEAR_TO_FAR)[shades(points, ends.get(lidar, (0.0, 1.0)))]
                radius = s.rr.Radius.ui_points(POINT)
                s.at(f"{entity}/{lidar}", second, s.rr.Points2D(points.uv + 0.5, colors=colors, radii=radius))
            outline = _strips(target_in_image(c, path, camera, at_camera, second) + 0.5)
            s.at(f"{entity}/target", second, s.rr.LineStrips2D(outline, colors=rgb(_TARGET)))

        return show

    @cached_property
    def clouds(self) -> dict[str, LidarStream]:
        """The scans of each LiDAR."""
        return {x.name: scans(self.recording, x) for x in self.rig.sensors.values() if isinstance(x, Lidar)}

    def _scans(self, s: RerunStream, sensor: Lidar) -> list[str]:
        stream = self.clouds[sensor.name]
        seconds = self._clock(sensor.name).seconds(stream.stamps_ns)
        inside = self._during(sensor.name, seconds)
        heights, path = None, CubicPath.of(self.calibration)
        for k in inside[:: _stride(len(inside), MOST_SCANS)]:
            points = self.points_in_world(path, sensor.name, stream, int(k), float(seconds[k]))
            if len(points) and heights is None:
                heights = np.percentile(points[:, 2], _HEIGHTS)
            low, high = (0.0, 1.0) if heights is None else heights
            colors, radius = by_value(points[:, 2], low, high), s.rr.Radius.ui_points(POINT)
            cloud = s.rr.Points3D(points, colors=colors, radii=radius)
            s.at(f"world/scans/{sensor.name}", float(seconds[k]), cloud)
        most = int(np.diff(stream.start)[inside].max())
        return [
            *_thinned(sensor.name, len(inside), MOST_SCANS, "scans"),
            *_thinned(sensor.name, most, MOST_POINTS, "points of a scan"),
        ]

    def points_in_world(self, path: CubicPath, name: str, stream: ScanPoints, scan: int, second: float) -> np.ndarray:
        """(n, 3) float32 points of scan number `scan` in the world [m], each by the pose of the body at its instant
        (motion compensation). second: time of the scan in the result.

        At most MOST_POINTS points are used, evenly spaced; points at instants without a known pose are left out."""
        begin, end = (int(x) for x in stream.start[scan : scan + 2])
        rows = slice(begin, end, _stride(end - begin, MOST_POINTS))
        T = self.calibration.T_imu_sensor(name)
        R, p, known = path.at(second + stream.offset_s[rows].astype(np.float64))
        on_body = stream.xyz[rows].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        world = np.einsum("nij,nj->ni", R, on_body) + p
        return world[known].astype(np.float32)


def _instant(clock: Clock, stamp_ns: int) -> np.ndarray:
    return clock.seconds(np.array([stamp_ns], np.int64))


def _stride(count: int, most: int) -> int:
    """Step with which to take items from `count`, so that at most `most` are taken."""
    return max(1, -(-count // most))


def _thinned(name: str, count: int, most: int, what: str) -> list[str]:
    stride = _stride(count, most)
    return [f"{name}: one in {stride} of its {count} {what} is shown."] if stride > 1 else []


_DOT = 3.0  # radius, in screen points
_GOOD, _LEFT_OUT = "#22c55e", "#9ca3af"


def log_residuals(s: RerunStream, c: Calibration) -> None:
    """Sends the residuals of all sensors over time, and for cameras also the measured image points."""
    for r in c.residuals.values():
        for curve in curves(c, r):
            name = re.sub(r"[^0-9a-zA-Z]+", "_", curve.name)
            entity = f"residuals/{r.sensor}/{name}" if name else f"residuals/{r.sensor}"
            log_lines(s, entity, curve.seconds, curve.values, curve.labels)
    _log_observations(s, c)


def log_states(s: RerunStream, c: Calibration) -> None:
    """Sends velocity [m/s] and biases [deg/s, m/s^2] at the keyframes; nothing without an IMU."""
    path = c.trajectory
    if c.imu is None:
        return
    log_lines(s, "motion/velocity", path.seconds, path.velocity, "xyz")
    log_lines(s, "motion/gyro_bias", path.seconds, np.rad2deg(path.gyro_bias), "xyz")
    log_lines(s, "motion/accel_bias", path.seconds, path.accel_bias, "xyz")


def log_lines(s: RerunStream, entity: str, seconds: np.ndarray, values: np.ndarray, names: Sequence[str]) -> None:
    """Sends curves over time. seconds (n,); values (n, m): a column for each of the m names."""
    colors = AXIS_COLORS if len(names) == 3 else COLORS[: len(names)]
    s.still(entity, s.rr.SeriesLines(names=list(names), colors=rgb(*colors)))
    n, m = values.shape
    s.over(entity, seconds, s.rr.Scalars.columns(scalars=values.reshape(-1)).partition([m] * n))


def _log_observations(s: RerunStream, c: Calibration) -> None:
    """Sends measured corners and tracked points in the images; rejected ones are red, those of unused tracks grey."""
    rr = s.rr
    for r in c.image_residuals:
        entity = f"{place(c, r.sensor)}/image/{r.kind}"
        s.still(entity, rr.Points2D.from_fields(radii=rr.Radius.ui_points(_DOT)))
        colors = rgb(_LEFT_OUT, _GOOD, REJECTED)[np.where(r.rejected, 2, r.used.astype(np.int64))]
        columns = rr.Points2D.columns(positions=r.uv + 0.5, colors=colors).partition(np.diff(r.start))
        s.over(entity, r.seconds, columns)


# Layout of the viewer's windows: world, rig, cameras, and curves over time.
#
# The result in 3D: the rig and its uncertainty, the trajectory, the target, and points on planes.


def blueprint(rr: Any, c: Calibration, readings: bool) -> Any:
    """Rerun's blueprint of the windows. rr: the rerun package; readings: whether IMU readings are shown."""
    b = rr.blueprint
    images = [b.Spatial2DView(origin=f"{place(c, name)}/image", name=name) for name in c.lenses]
    rig = b.Spatial3DView(origin=f"world/{c.reference}", name="rig")
    plots = [b.TimeSeriesView(origin=f"residuals/{name}", name=f"residuals of {name}") for name in _measured(c)]
    if c.imu is not None:
        plots.append(b.TimeSeriesView(origin="motion", name="motion"))
    if readings and c.imu is not None:
        plots.append(b.TimeSeriesView(origin=f"readings/{c.imu}", name=f"readings of {c.imu}"))
    right = b.Vertical(b.Tabs(rig, b.TextDocumentView(origin="summary", name="summary")), *images[:2])
    # Points on planes have a view of their own, as they would hide moving sensors.
    space = [b.Spatial3DView(origin="world", contents=["$origin/**", "- $origin/planes/**"], name="world")]
    if c.planes:
        parts = [f"$origin/{part}/**" for part in ("planes", "target", "trajectory")]
        space.append(b.Spatial3DView(origin="world", contents=parts, name="planes"))
    left = b.Vertical(b.Tabs(*space), b.Tabs(*plots), row_shares=[3, 1])
    more = [b.Tabs(*images[2:])] if images[2:] else []
    return b.Blueprint(
        b.Horizontal(left, right, *more, column_shares=[3, 2, 1][: 2 + len(more)]),
        b.TimePanel(timeline=TIMELINE, state="collapsed"),
        collapse_panels=True,
    )


def _measured(c: Calibration) -> list[str]:
    """Names of sensors with residuals over time, the IMU last."""
    names = dict.fromkeys(r.sensor for r in c.residuals.values() if len(r.seconds))
    return sorted(names, key=lambda name: name == c.imu)


POINT = 1.5  # radius of a point of a scan, in screen points
_TARGET, _TRAJECTORY = "#be185d", "#64748b"
_WORST_OF_SCALE = 4.0  # residual at the top of the colour scale, in RMS of the residuals


def place(c: Calibration, sensor: str) -> str:
    """Rerun's entity path of a sensor: the body is below the world, all other sensors are below the body."""
    return f"world/{sensor}" if sensor == c.reference else f"world/{c.reference}/{sensor}"


def spans(c: Calibration) -> tuple[RecordingSpan, ...]:
    """The recordings of the result; one span without a name if the result does not list them."""
    ends = c.trajectory.seconds[[0, -1]].tolist()
    return c.recordings or (RecordingSpan("", ends[0], ends[1], 0),)


def log_rig(s: RerunStream, c: Calibration) -> None:
    """Sends frames and shapes of all sensors, at constant poses relative to the body."""
    spread = rig_figures.spread_of(c)
    for name, T in rig_figures.frames_of(c).items():
        s.still(place(c, name), s.rr.TransformAxes3D(0.25 * spread))
        if name != c.reference:
            s.still(place(c, name), s.rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
    for name in c.lenses:
        s.still(f"{place(c, name)}/image", _pinhole(s, c, name, 0.45 * spread))
    others = [name for name in c.mounted if name not in c.lenses]
    shapes = [(name, pen) for name in others if (pen := rig_figures.shape_of(c, name)) is not None]
    for i, (name, pen) in enumerate(shapes):
        strips = s.rr.LineStrips3D(_strips(pen), colors=rgb(COLORS[i % len(COLORS)]))
        s.still(f"{place(c, name)}/shape", strips)


def _pinhole(s: RerunStream, c: Calibration, name: str, depth: float):
    """Rerun's pinhole camera, without distortion. In Rerun pixel (0, 0) is the corner of the image, in icalib the
    centre of the first pixel. depth [m]: distance of the drawn image."""
    fx, fy, cx, cy = c.group(name, "intrinsics").value
    return s.rr.Pinhole(
        resolution=c.rig["sensors"][name]["resolution"],
        focal_length=(fx, fy),
        principal_point=(cx + 0.5, cy + 0.5),
        image_plane_distance=depth,
    )


def log_uncertainty(s: RerunStream, c: Calibration) -> None:
    """Sends the uncertainty ellipsoids of positions, with a common magnification, coloured by verdict."""
    factor = magnification(c)
    for e in ellipsoids(c):
        ellipsoid = s.rr.Ellipsoids3D(
            half_sizes=[factor * e.half_sizes],
            centers=[c.group(e.sensor, "translation").value],
            quaternions=[Rotation.from_matrix(e.axes).as_quat()],
            colors=rgb(VERDICT_COLORS[e.verdict]),
            labels=[f"{e.sensor}: {SIGMAS:g} sigma x {factor:g}"],
            show_labels=False,
        )
        s.still(f"world/{c.reference}/uncertainty/{e.sensor}", ellipsoid)


def log_motion(s: RerunStream, c: Calibration) -> None:
    """Sends the pose of the reference sensor at each keyframe, and the whole trajectory of each recording."""
    path = c.trajectory
    s.still("world", s.rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    s.over(
        f"world/{c.reference}",
        path.seconds,
        s.rr.Transform3D.columns(translation=path.position, mat3x3=path.rotation.reshape(-1, 9)),
    )
    of = c.recording_of(path.seconds)
    for k, span in enumerate(spans(c)):
        s.at("world/trajectory", span.start, s.rr.LineStrips3D([path.position[of == k]], colors=rgb(_TRAJECTORY)))


def log_target(s: RerunStream, c: Calibration) -> None:
    """Sends outline and points of each body of the target. The target has one orientation in the world per
    recording."""
    target, orientations = target_from_plain(c.rig), scene_in_worlds(c)
    if target is None or not orientations:
        return
    for span, (_, R) in zip(spans(c), orientations, strict=False):
        s.at("world/target", span.start, s.rr.Transform3D(mat3x3=R))
    for body in c.bodies or target.bodies:
        k, T = target.bodies.index(body), c.T_scene_body(body) if c.bodies else np.eye(4)
        entity = f"world/target/{body}"
        s.still(entity, s.rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        outline = _strips(rig_figures.body_outline(target, k))
        s.still(f"{entity}/outline", s.rr.LineStrips3D(outline, colors=rgb(_TARGET)))
        s.still(f"{entity}/points", s.rr.Points3D(target.points[target.body == k], colors=rgb(_TARGET)))


def log_planes(s: RerunStream, c: Calibration) -> None:
    """Sends the measured points that belong to planes, coloured by the size of their residuals."""
    for cloud in (cloud for presenter in presenters().values() for cloud in presenter.clouds(c)):
        of, size = c.recording_of(cloud.seconds), cloud.size
        top = _WORST_OF_SCALE * float(np.sqrt(np.mean(size**2))) if len(size) else 1.0
        for k, span in enumerate(spans(c)):
            rows = of == k
            colors, radius = by_value(size[rows], 0.0, top), s.rr.Radius.ui_points(POINT)
            points = s.rr.Points3D(cloud.points[rows], colors=colors, radii=radius)
            s.at(f"world/planes/{cloud.sensor}", span.start, points)


def _strips(pen: np.ndarray) -> list[np.ndarray]:
    """Polylines from points (N, 3), in which a row of NaN separates two lines."""
    up = np.isnan(pen[:, 0])
    pieces = np.split(pen, np.flatnonzero(up))
    return [p for piece in pieces if len(p := piece[~np.isnan(piece[:, 0])]) > 1]
