"""Shows the recording of a result: IMU readings, images and scans, placed by the calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Protocol

import numpy as np

from icalib.data.recordings import DamagedImageError, Recording, decode
from icalib.errors import CalibrationError, RecordingError
from icalib.result import Calibration, RecordingSpan
from icalib.rig import Rig
from icalib.sensors import call_all_kinds, call_kind
from icalib.sensors.sensor import Sensor
from icalib.tools.view.colors import by_value
from icalib.tools.view.path import CubicPath
from icalib.tools.view.scene import POINT, place
from icalib.tools.view.series import log_lines
from icalib.tools.view.stream import RerunStream

MOST_READINGS = 100_000  # shown of an IMU
MOST_IMAGES = 600  # shown of a camera
MOST_SCANS, MOST_POINTS = 400, 15_000  # shown of a sensor, and of a scan
JPEG_QUALITY = 75
_EDGE_S = 1.0  # data this long before and after the span of the result belong to it
_HEIGHTS = (2.0, 98.0)  # percentiles of the height between which colours change

Progress = Callable[[str, float], None]


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
class Clock:
    """Converts raw stamps of one sensor to seconds of the result. offset_s: time offset, which is added to the stamps
    to get the body's clock; span: the recording."""

    span: RecordingSpan
    offset_s: float

    @classmethod
    def of(cls, c: Calibration, span: RecordingSpan, sensor: str) -> Clock:
        values = [g.value for g in c.groups if (g.sensor, g.name) == (sensor, "time_offset")]
        if not values:
            return cls(span, 0.0)
        (value,) = values
        return cls(span, float(value[c.recordings.index(span) if len(value) > 1 else 0]))

    def seconds(self, stamps_ns: np.ndarray) -> np.ndarray:
        """(n,) seconds of the result from int64 stamps [ns]. Whole nanoseconds are subtracted first, so that no digit
        is lost."""
        since = stamps_ns - np.int64(self.span.origin_ns) + np.int64(round(1e9 * self.offset_s))
        return self.span.start + 1e-9 * since.astype(np.float64)

    def within(self, seconds: np.ndarray) -> np.ndarray:
        """(n,) bool: whether `seconds` (n,) are within the recording, or less than _EDGE_S outside."""
        return (seconds > self.span.start - _EDGE_S) & (seconds < self.span.end + _EDGE_S)


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
            if not sensor.tracks_points or call_kind(sensor.sensor_type, "read", "sees", self.recording, sensor):
                self.recording.where(sensor)

    def log(self, s: RerunStream, progress: Progress) -> list[str]:
        """Sends all data to Rerun, and returns sentences on data that were left out."""
        sensors = self.rig.sensors.values()
        topics: dict[str, str] = dict(call_all_kinds("read", "image_sources", self.recording, self.rig))
        work = [(sensor.name, lambda x=sensor: self._readings(s, x)) for sensor in sensors if sensor.is_inertial]
        work += [(sensor.name, lambda x=sensor: self._scans(s, x)) for sensor in sensors if sensor.shows_planes]
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

    def _readings(self, s: RerunStream, sensor: Sensor) -> list[str]:
        stamps_ns, readings = call_kind(sensor.sensor_type, "read", "time_series", self.recording, sensor)
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
        clock, damaged, n_sent = self._clock(name), 0, 0
        within = (p for p in self.recording.payloads(topic) if clock.within(_instant(clock, p.stamp_ns))[0])
        for payload in islice(within, 0, None, _stride(count, MOST_IMAGES)):
            try:
                image = s.rr.Image(decode(payload), "L").compress(jpeg_quality=JPEG_QUALITY)
            except DamagedImageError:
                damaged += 1
                continue
            s.at(f"{place(self.calibration, name)}/image", float(_instant(clock, payload.stamp_ns)[0]), image)
            n_sent += 1
        notes = [f"{name}: {damaged} damaged images are not shown."] if damaged else []
        return notes + _thinned(name, count, MOST_IMAGES, "images")

    def _scans(self, s: RerunStream, sensor: Sensor) -> list[str]:
        stream: ScanPoints = call_kind(sensor.sensor_type, "read", "scans", self.recording, sensor)
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
