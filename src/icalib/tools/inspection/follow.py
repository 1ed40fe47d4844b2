"""Follows a recording that is being written: what has arrived, how good a calibration would be, and what to do next.

What is new is read in small parts, each a recording of its own for the readers of all kinds. The last minutes are
calibrated coarsely in a process of their own, over and over; standard deviations of the whole follow from that, and
until the next solve from what has arrived since.
"""

from __future__ import annotations

import multiprocessing
import signal
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from itertools import groupby
from math import inf
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.live import Live

from icalib.data.folder import GrowingFolder
from icalib.data.measurements import CornerStream, ImuStream, Measurements
from icalib.data.messages import TopicInfo, choose_topic, listing
from icalib.data.recording import Growing, NewPart
from icalib.data.recordings import DamagedImageError, Recording, decode, open_growing_recording, read_measurements
from icalib.data.stamps import LONGEST_S
from icalib.detection.decoding import ImageCorners, corner_stream
from icalib.detection.detectors import Detector, detector_of
from icalib.detection.images import number_continuously, without_rare_tags
from icalib.errors import CalibrationError, RecordingError, RigError
from icalib.geometry.targets import Scene
from icalib.kinds import inspectors
from icalib.pipeline import calibrate_measurements
from icalib.result import ParameterGroup
from icalib.rig import ImuSensor, Rig, Sensor
from icalib.rig.file import load_rig, rig_from_dict
from icalib.sensors.camera.read.detected_corners import checked_corners
from icalib.sensors.imu.read import in_si
from icalib.sensors.imu.read import readings as imu_readings
from icalib.sensors.imu.spec import DEFAULT_CLASS, class_noise
from icalib.sensors.parameter import display_unit
from icalib.sensors.sensor import MOUNTED_NAMES, TIME_OFFSET
from icalib.tools.batch import sentence_on
from icalib.tools.inspection import find_sources
from icalib.tools.inspection.console import GRID, Grid, Page, View, coverage, coverage_map, empty_borders, screen
from icalib.tools.inspection.facts import GivenTarget

LOOK_EVERY_S = 0.2
WINDOW_S = 120.0  # longest recorded time of a coarse problem, which memory is proportional to
SHORTEST_WINDOW_S = 20.0  # which most first guesses need
SOLVE_S = 10.0  # processor time of a solve, by which the recorded time of a coarse problem is chosen
SEARCH_HZ = 10.0  # images of a camera that are searched; standard deviations of all are extrapolated from these
SEARCH_SHARE = 0.25  # of a core, at most, for the search of images
SLOWEST_SEARCH_S = 0.5  # of an image, as far as SEARCH_SHARE counts it: the first one waits for its compiled code
SOLVE_SHARE = 0.2  # of a core, at most, for solves
RECENT = 100  # stamps from which a rate is computed
FEWEST_VIEWS = 25  # images with the target before the first solve; a first guess needs 20 pairs
SET_BACK_NS = 1_000_000_000  # a clock that goes back by more was set, and what was before is left out

# The coarse problem. It runs in a process of its own.


@dataclass(frozen=True)
class CoarseProblem:
    """What a solve needs. parts: of the last minutes, without images; corners: of the searched images of each camera.

    density: recorded images of the last minutes over those that were searched. share: recorded time of `parts` over
    that of the whole recording, which lasts `seconds`. progress: see `Follower`.
    """

    rig: Rig
    parts: tuple[NewPart, ...]
    corners: tuple[CornerStream, ...]
    density: float
    share: float
    seconds: float
    progress: tuple[float, ...] = ()


@dataclass(frozen=True)
class ExpectedStd:
    """Standard deviation of one number of a calibration, from the first `seconds` of a recording. unit: SI; std:
    infinite if the motion so far does not show it."""

    sensor: str
    group: str
    label: str
    unit: str
    std: float
    tolerance: float
    seconds: float

    @property
    def needed_s(self) -> float:
        """Seconds more until `std` is `tolerance`, if the motion goes on; 0: it is determined."""
        return float(self.seconds * max((self.std / self.tolerance) ** 2 - 1.0, 0.0))


@dataclass(frozen=True)
class Expectation:
    """Outcome of a coarse problem. stds: of extrinsics, time offsets and lenses; rotations: R_imu_sensor of each
    sensor; hidden: sentences on combinations that the motion does not show; problem: why there is no outcome.
    seconds, progress: recorded time that it holds for, and what was seen by then, as of `Follower`."""

    seconds: float
    stds: tuple[ExpectedStd, ...] = ()
    rotations: Mapping[str, np.ndarray] = field(default_factory=dict)
    hidden: tuple[str, ...] = ()
    problem: str = ""
    progress: tuple[float, ...] = ()

    def stds_at(self, seconds: float, progress: tuple[float, ...]) -> tuple[ExpectedStd, ...]:
        """The standard deviations of a longer recording: variances fall as the least of its progress grows."""
        growth = min((now / then for then, now in zip(self.progress, progress, strict=False) if then), default=1.0)
        factor, seconds = float(np.sqrt(1.0 / growth)), max(seconds, self.seconds)
        return tuple(replace(s, std=factor * s.std, seconds=seconds) for s in self.stds)


def predict(problem: CoarseProblem) -> Expectation:
    """Calibrates the coarse problem, and once more with half of its images.

    The formal variance is a + b / n for n images, as the noise of the other sensors limits how much more images help; a
    and b follow from the two solves, and give the variance for all recorded images. Segments scatter more than that
    because errors of corners are alike in images that follow one another: what the squared empirical factor has above 1
    is proportional to the rate of the images. All variances fall with the length of the recording.
    """
    rig = problem.rig.with_("settings", images_in_report=False)
    try:
        measured = _measurements(problem, rig)
        whole = halved = calibrate_measurements(rig, measured)
        if problem.density > 1.0:
            half = measured.with_streams(*(_every_second(c) for c in measured.cameras))
            with suppress(CalibrationError):  # too few: then more images count for nothing
                halved = calibrate_measurements(rig.with_("settings", segments=0), half)
    except Exception as error:  # the recording goes on, and another minute may be fit
        return Expectation(problem.seconds, problem=sentence_on(error))
    groups = [g for g in whole.groups if g.sensor in rig.sensors and g.mode != "fixed"]
    groups = [g for g in groups if g.name in (*MOUNTED_NAMES, "intrinsics") and g.unit and g.std_formal.all()]
    stds = [std for g in groups for std in _expected(problem, g, halved.group_or_none(g.sensor, g.name))]
    turned = {g.sensor: g.value for g in whole.groups if g.name == "rotation"}
    hidden = tuple(map(str, whole.unobservable))
    return Expectation(problem.seconds, tuple(stds), turned, hidden, progress=problem.progress)


def _expected(problem: CoarseProblem, g: ParameterGroup, halved: ParameterGroup | None) -> Iterator[ExpectedStd]:
    """Standard deviations of a group, from those of the coarse problem and of its half."""
    variance = g.std_formal**2
    of_half = variance if halved is None else halved.std_formal**2
    by_images = np.clip(of_half - variance, 0.0, variance)
    formal = variance - by_images + by_images / problem.density
    excess = (g.std / g.std_formal) ** 2 - 1.0
    std = np.sqrt(problem.share * formal * (1.0 + problem.density * excess))
    sensor = problem.rig.sensors[g.sensor]
    given = sensor.spec(g.name).tolerance
    tolerance = problem.rig.settings.tolerance(given) if isinstance(given, str) else given
    for k, t in enumerate(np.broadcast_to(tolerance, std.shape).tolist()):
        size = float(std[k]) if g.verdict[k] != "unobservable" else np.inf
        yield ExpectedStd(g.sensor, g.name, g.labels[k], g.unit, size, t, problem.seconds)


def _measurements(problem: CoarseProblem, rig: Rig) -> Measurements:
    """Measurements of the parts and the corners."""
    others = rig.without(*(c.name for c in problem.corners))
    sizes = {camera.name: camera.resolution for camera in rig.cameras}
    corners = [checked_corners(c, c.name, sizes[c.name])[0] for c in problem.corners]
    if not others.sensors:
        return Measurements.of_streams(*corners)
    with tempfile.TemporaryDirectory(prefix="icalib-") as folder:
        first, *rest = problem.parts
        recording = first.joined(rest).recording(Path(folder))
        return read_measurements(recording, others).with_streams(*corners)


def _every_second(c: CornerStream) -> CornerStream:
    kept = np.arange(len(c.stamps_ns)) % 2 == 0
    return c.of_rows(kept[c.image], c.stamps_ns[kept], np.diff(c.start)[kept])


def _work(pipe: Connection) -> None:
    """Solves each problem that comes, until the other end is closed. Sends the outcome, and its processor time [s]."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends it to all processes; the first one ends them
    with suppress(EOFError, OSError):
        pipe.send(None)
        while True:
            problem, begin = pipe.recv(), time.process_time()
            pipe.send((predict(problem), time.process_time() - begin))


class Solver:
    """Solves coarse problems one at a time in a process of its own, with rests. latest: the last outcome; window_s:
    recorded time that the next problem should have at most, so that its solve takes SOLVE_S."""

    def __init__(self) -> None:
        self.latest: Expectation | None = None
        self.window_s = WINDOW_S
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, end = context.Pipe()
        self._process = context.Process(target=_work, args=(end,), daemon=True)
        self._process.start()
        end.close()
        self._is_idle, self._begun, self._free_at, self._solved_s = False, time.monotonic(), 0.0, 0.0

    def offer(self, make: Callable[[float], CoarseProblem | None]) -> None:
        """Takes the outcome of a solve that has ended, and begins one if it is time."""
        try:
            if not self._is_idle and self._pipe.poll():
                self._is_idle = True
                if (answer := self._pipe.recv()) is not None:  # None: the process is ready
                    took = answer[1] if self.latest else min(answer[1], SOLVE_S)  # the first one compiles its code
                    self.latest = answer[0]
                    self._free_at = self._begun + took / SOLVE_SHARE
                    self.window_s = float(np.clip(self._solved_s * SOLVE_S / took, SHORTEST_WINDOW_S, WINDOW_S))
            if self._is_idle and time.monotonic() >= self._free_at and (problem := make(self.window_s)) is not None:
                self._begun, self._is_idle, self._solved_s = time.monotonic(), False, problem.share * problem.seconds
                self._pipe.send(problem)
        except (EOFError, OSError):  # the process was killed, such as for lack of memory
            self.close()
            self._start()

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


# What has arrived.


@dataclass
class Arrivals:
    """One topic. recent: its last stamps [ns]; arrived: when the last message came, by `time.monotonic`.

    searched, seen: images that were searched, the last one at searched_ns, and those with the target; sees: whether the
    last one had it. cells (rows, columns): number of corners over the image; size: (width, height) px, None before the
    first image."""

    topic: TopicInfo
    recent: deque[int] = field(default_factory=lambda: deque(maxlen=RECENT))
    arrived: float = 0.0
    searching: float = 0.0  # processor time [s] that the search of images took
    searched: int = 0
    searched_ns: int = -(2**62)
    seen: int = 0
    sees: bool = False
    cells: np.ndarray = field(default_factory=lambda: np.zeros(GRID[::-1], np.int64))
    size: tuple[int, int] | None = None

    def note(self, stamps_ns: Sequence[int]) -> float:
        """Notes new stamps. Returns the recorded time [s] that they add; NaN if the clock was set."""
        steps = np.diff([*list(self.recent)[-1:], *stamps_ns])
        self.recent.extend(stamps_ns)
        was_set = ((steps < -SET_BACK_NS) | (steps > 1e9 * LONGEST_S)).any()
        return np.nan if was_set else float(1e-9 * steps.sum())

    @property
    def rate_hz(self) -> float:
        """From the median interval of the last stamps; 0 before the second one."""
        steps = np.diff(np.array(self.recent, np.int64))
        return float(1e9 / np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


@dataclass
class Motion:
    """Sums over the readings of the IMU. turning (3, 3): integral of w w^T [rad^2/s]; accel, accel2 (3,): sums of the
    specific force and of its squares."""

    seconds: float = 0.0
    count: int = 0
    turning: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    accel: np.ndarray = field(default_factory=lambda: np.zeros(3))
    accel2: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def add(self, imu: ImuStream, rate_hz: float) -> None:
        """Adds readings, which come at rate_hz."""
        step = 1.0 / rate_hz if rate_hz else 0.0
        self.seconds += step * len(imu.gyro)
        self.count += len(imu.gyro)
        self.turning += step * imu.gyro.T @ imu.gyro
        self.accel += imu.accel.sum(axis=0)
        self.accel2 += (imu.accel**2).sum(axis=0)

    def rates(self, R_imu_sensor: np.ndarray) -> np.ndarray:
        """(3,) RMS angular rate [rad/s] about the axes of a sensor."""
        turning = R_imu_sensor.T @ self.turning @ R_imu_sensor
        return np.sqrt(np.maximum(np.diag(turning), 0.0) / max(self.seconds, 1e-9))

    def least_turned(self, R_imu_sensor: np.ndarray) -> str:
        """Name of the axis of a sensor about which it turned least."""
        return "xyz"[int(np.argmin(self.rates(R_imu_sensor)))]

    def shaking(self) -> np.ndarray:
        """(3,) RMS of the specific force about its mean [m/s^2], imu frame."""
        mean = self.accel / max(self.count, 1)
        return np.sqrt(np.maximum(self.accel2 / max(self.count, 1) - mean**2, 0.0))


@dataclass(frozen=True)
class Kept:
    """A part in memory: `part` without images and clouds, recorded seconds, and corners with stamps by camera."""

    part: NewPart
    seconds: float
    corners: Mapping[str, Sequence[tuple[int, ImageCorners]]]


@contextmanager
def _noted(sentences: dict[str, str], name: str, root: Path, instead: Path) -> Iterator[None]:
    """Keeps the sentence of a RecordingError by `name`, until there is none. `instead` replaces `root` in it."""
    try:
        yield
        sentences.pop(name, None)
    except RecordingError as error:
        sentences[name] = str(error).replace(str(root), str(instead))


class Follower:
    """Everything that is known of a recording that is being written; `look` reads what is new. given: the target, and
    the rig if its file is a rig file.

    topics: by name; sensors: topic of each sensor, the reference first; seconds: recorded time so far; arrived: when
    the last part was read, by `time.monotonic`. Sentences: problem: on the whole, "" if there is none; missing: on each
    sensor of the rig file without a topic; unread: on each file or topic that is not read.
    """

    def __init__(self, root: Path, given: GivenTarget | None = None) -> None:
        self.root = root
        self.topics: dict[str, Arrivals] = {}
        self.sensors: dict[str, TopicInfo] = {}
        self.motion, self.seconds, self.arrived, self.problem = Motion(), 0.0, inf, ""
        self.missing: dict[str, str] = {}
        self.unread: dict[str, str] = {}
        self.target = given.target if given is not None and len(given.target.bodies) else None
        self._stated = load_rig(given.file) if given is not None and given.sensors else None
        self._detector: Detector | None = None
        with suppress(RigError):  # a target whose corners come as a table
            self._detector = None if self.target is None else detector_of(self.target)
        self._kept: deque[Kept] = deque()
        self._recorded: dict[str, float] = {}  # seconds by sensor
        self._source: Growing | None = None
        self._began = time.monotonic()

    def look(self) -> bool:
        """Reads a part of what is new; whether there was any."""
        try:
            self._source = self._source or open_growing_recording(self.root)
            part = None if self._source is None else self._source.part()
            files = {} if self._source is None else {str(p): sentence for p, sentence in self._source.unread.items()}
            self.unread = {name: self.unread[name] for name in self.unread if name in self.topics} | files
            self.problem = "" if self.topics or part or files else self._nothing()
            if part is not None:
                with tempfile.TemporaryDirectory(prefix="icalib-") as folder:
                    self._take(part, part.recording(Path(folder)))
                self.arrived = time.monotonic()  # after a search that may have waited for its compiled code
        except (OSError, RecordingError) as error:
            self.problem = str(error)
            return False
        return part is not None

    def _nothing(self) -> str:
        """A sentence on a recording of which nothing has arrived."""
        if not self.root.exists():
            return f"{self.root} is not there yet; start the recorder, or correct the path."
        what = "messages" if self.root.is_file() else "bag, table or images"
        return f"{self.root} has no {what} yet; start the recorder, or give the bag or folder that it writes."

    def _take(self, part: NewPart, recording: Recording) -> None:
        """Notes what a part holds, and keeps what a coarse problem needs."""
        new = [t for t in recording.topics() if t.count]
        for topic in new:
            known = self.topics.setdefault(topic.name, Arrivals(replace(topic, count=0)))
            known.topic = replace(known.topic, count=known.topic.count + topic.count)
            known.arrived = time.monotonic()
        self.sensors = self._topics_of_sensors()
        names = {t.name: name for name, t in self.sensors.items()}
        added: dict[str, float] = {}
        corners: dict[str, list[tuple[int, ImageCorners]]] = {}
        for topic in (t for t in new if t.kind):
            with _noted(self.unread, topic.name, recording.root, self.root):
                name = names.get(topic.name, topic.name)
                if topic.kind == "image":
                    added[name], corners[name] = self._search(recording, self.topics[topic.name])
                elif len(stamps := recording.stamps(topic.name).tolist()):
                    added[name] = self.topics[topic.name].note(stamps)
        if np.isnan(list(added.values())).any():
            self._kept.clear()
        for name, s in added.items():
            self._recorded[name] = self._recorded.get(name, 0.0) + np.nan_to_num(s)
        # Sensors may come one after the other: time counts once.
        seconds = max(max(self._recorded.values(), default=0.0) - self.seconds, 0.0)
        self._feel(recording)
        clouds = {t.name for t in new if t.kind in ("points", "")}
        self._keep(Kept(part.without(clouds), seconds, corners))

    def _topics_of_sensors(self) -> dict[str, TopicInfo]:
        """Topic by name of the sensor: of the rig file, or of all topics that may be sensors. The IMU comes first."""
        topics = [arrivals.topic for arrivals in self.topics.values()]
        if self._stated is None:
            named = {name: source.topic for name, source in find_sources(topics).sensors.items()}
        else:
            named = {}
            for name, sensor in self._stated.sensors.items():
                with _noted(self.missing, name, self.root, self.root):
                    named[name] = self._topic_of(sensor, topics)
        return dict(sorted(named.items(), key=lambda item: item[1].kind != "imu"))

    def _topic_of(self, sensor: Sensor, topics: list[TopicInfo]) -> TopicInfo:
        """The topic of a sensor of the rig file. Raises RecordingError while it has none."""
        kinds = inspectors()[sensor.sensor_type].topic_kinds
        topic, path = (getattr(sensor, name, None) for name in ("topic", "path"))
        if tables := [t for t in topics if t.name == path and t.kind in kinds]:
            return tables[0]
        if isinstance(path, str) and "image" not in kinds and isinstance(self._source, GrowingFolder):
            raise RecordingError(f"{self.root} has no {path}; {listing(topics)}; set `path` in the rig file.")
        return choose_topic(str(self.root), topics, sensor.name, topic, *(("image",) if "image" in kinds else kinds))

    def _search(self, recording: Recording, camera: Arrivals) -> tuple[float, list[tuple[int, ImageCorners]]]:
        """Notes the images of a camera. Returns the recorded time [s] that they add, and stamps and corners of those
        that are searched: at SEARCH_HZ, or fewer while the search takes more than SEARCH_SHARE of the time."""
        seconds, searched = 0.0, []
        for payload in recording.payloads(camera.topic.name):
            is_due = abs(payload.stamp_ns - camera.searched_ns) >= 1e9 / SEARCH_HZ
            seconds += camera.note([payload.stamp_ns])
            camera.size = (payload.width, payload.height) if payload.width else camera.size
            if self._detector is None or not is_due or camera.searching > self._may_search():
                continue
            begin = time.process_time()
            with suppress(DamagedImageError):
                image = decode(payload)
                camera.size = image.shape[1], image.shape[0]
                corners = self._detector.detect(image)
                searched.append((payload.stamp_ns, corners))
                camera.searched_ns = payload.stamp_ns
                self._note_corners(camera, corners)
            camera.searching += min(time.process_time() - begin, SLOWEST_SEARCH_S)
        return seconds, searched

    def _may_search(self) -> float:
        """Processor time [s] that the search may have taken so far, for each camera."""
        cameras = sum(arrivals.topic.kind == "image" for arrivals in self.topics.values())
        return SEARCH_SHARE * (time.monotonic() - self._began + 1.0) / cameras

    def _note_corners(self, camera: Arrivals, corners: ImageCorners) -> None:
        uv = corners.uv[corners.kept]
        camera.searched += 1
        camera.sees = len(uv) > 0
        camera.seen += camera.sees
        if camera.size is not None and camera.sees:
            camera.cells += np.array(coverage(uv, camera.size))

    def _feel(self, recording: Recording) -> None:
        """Adds the readings of the IMU to the motion."""
        name, topic = next(iter(self.sensors.items()), ("", None))
        if topic is None or topic.kind != "imu":
            return
        unstated = ImuSensor(name, topic.name, class_noise(DEFAULT_CLASS), topic=topic.name)
        sensor = self._stated.sensors[name] if self._stated else unstated
        with _noted(self.unread, topic.name, recording.root, self.root):
            if isinstance(sensor, ImuSensor) and isinstance(imu := imu_readings(recording, sensor), ImuStream):
                self.motion.add(in_si(imu, sensor), self.topics[topic.name].rate_hz)

    def _keep(self, kept: Kept) -> None:
        """Keeps a part, and lets the oldest go: all but WINDOW_S of recorded time."""
        self.seconds += kept.seconds
        self._kept.append(kept)
        while sum(k.seconds for k in self._kept) - self._kept[0].seconds > WINDOW_S:
            self._kept.popleft()

    def rig(self) -> Rig | None:
        """The rig of the sensors that have come so far: as stated, or else an IMU and cameras with a usual lens."""
        if self._stated is not None:
            return self._stated.only(*self.sensors) if self.sensors else None
        sensors: dict[str, Any] = {}
        for name, topic in self.sensors.items():
            place = {"path" if topic.name.endswith(".csv") else "topic": topic.name}
            if topic.kind == "imu" and not sensors:
                sensors[name] = {"type": "imu", **place}
            elif topic.kind == "image" and self.target is not None and (size := self.topics[topic.name].size):
                sensors[name] = {"type": "camera", **place, "model": "pinhole-radtan", "resolution": [*size]}
        if self.target is None or not any(s["type"] == "camera" for s in sensors.values()):
            return None
        key = "targets" if isinstance(self.target, Scene) else "target"
        return rig_from_dict({"sensors": sensors, key: self.target.plain()}, str(self.root))

    @property
    def progress(self) -> tuple[float, float]:
        """Images in which a camera saw the target, and the integral of the squared angular rate [rad^2/s]; information
        is proportional to both."""
        return float(sum(a.seen for a in self.topics.values())), float(np.trace(self.motion.turning))

    def coarse_problem(self, longest_s: float = WINDOW_S) -> CoarseProblem | None:
        """The problem of the last `longest_s` of recorded time; None while there is too little."""
        if self.target is None or not self._kept or (rig := self.rig()) is None:
            return None
        begin = np.cumsum([k.seconds for k in reversed(self._kept)])[::-1] - longest_s
        recent = [kept for kept, before in zip(self._kept, begin, strict=True) if before <= 0.0] or [self._kept[-1]]
        share = min(sum(k.seconds for k in recent) / max(self.seconds, 1e-9), 1.0)
        corners, density = [], [1.0]
        for camera in rig.cameras:
            arrivals = self.topics[self.sensors[camera.name].name]
            images = [pair for kept in recent for pair in kept.corners.get(camera.name, ())]
            if arrivals.topic.kind != "image" or sum(bool(c.kept.any()) for _, c in images) < FEWEST_VIEWS:
                rig = rig if arrivals.topic.kind != "image" else rig.without(camera.name)
                continue
            stamps, views = zip(*images, strict=True)
            views, _ = without_rare_tags(self.target, number_continuously(self.target, views))
            corners.append(corner_stream(camera.name, np.array(stamps), views))
            density.append(arrivals.topic.count * share / len(stamps))
        rig = rig.without(*(s.name for s in rig.lidars))
        if not corners and not any(self.sensors[c.name].kind == "corners" for c in rig.cameras):
            return None
        parts = tuple(kept.part for kept in recent)
        return CoarseProblem(rig, parts, tuple(corners), max(density), share, self.seconds, self.progress)


# What is shown: tables, coverage of the images, and advice.


def view(f: Follower, prediction: Expectation | None) -> View:
    """What is known of a recording, and predicted."""
    if prediction is not None:
        prediction = replace(prediction, stds=prediction.stds_at(f.seconds, f.progress))
    cameras = [(name, f.topics[t.name]) for name, t in f.sensors.items() if t.kind == "image"]
    maps = tuple((name, coverage_map(a.cells.tolist())) for name, a in cameras if a.seen)
    tables = [_arrived(f)]
    if prediction is not None and prediction.stds:
        tables.append(_expected_table(prediction))
    if f.motion.count:
        tables.append(_moved(f, prediction))
    return View(f"{f.root}, {f.seconds:.0f} s recorded", tuple(_advice(f, prediction)), tuple(tables), maps)


def _arrived(f: Follower) -> Grid:
    """One row for each sensor, then for other topics."""
    names = {topic.name: name for name, topic in f.sensors.items()}
    rows = []
    for topic, a in sorted(f.topics.items(), key=lambda item: names.get(item[0], "~")):
        now = ("seen" if a.sees else "not seen") if a.searched else ""
        share = f"{a.seen / a.searched:.0%}" if a.searched else ""
        cells = f"{(a.cells > 0).sum()} of {a.cells.size}" if a.seen else ""
        rate = f"{a.rate_hz:.1f} Hz" if a.rate_hz else f"{a.topic.count} messages"
        rows.append((names.get(topic, ""), topic, rate, f"{time.monotonic() - a.arrived:.1f}", now, share, cells))
    headers = ("sensor", "topic", "rate", "age [s]", "target", "of images", "cells")
    return Grid("What arrives", headers, tuple(rows), len(names), 1)


def _moved(f: Follower, prediction: Expectation | None) -> Grid:
    """RMS angular rate about the axes of each sensor with a known rotation, and specific force in the imu frame."""
    imu = next(iter(f.sensors))
    frames = {imu: np.eye(3)} | dict({} if prediction is None else prediction.rotations)
    figures = {f"rotation about {name} [deg/s]": np.rad2deg(f.motion.rates(R)) for name, R in frames.items()}
    figures[f"acceleration along {imu} [m/s^2]"] = f.motion.shaking()
    rows = tuple((what, *(f"{v:.1f}" for v in values)) for what, values in figures.items())
    return Grid("Motion (RMS)", ("", "x", "y", "z"), rows, len(rows), 5)


def _expected_table(prediction: Expectation) -> Grid:
    """Standard deviations of extrinsics, time offsets and lenses, one row for each group: of a long one, the
    number that is farthest from its tolerance. Those that are determined come last."""
    rows = []
    for (sensor, group), alike in groupby(prediction.stds, key=lambda s: (s.sensor, s.group)):
        stds = list(alike)
        unit, factor = display_unit(stds[0].unit)
        needed = max(s.needed_s for s in stds)
        state = "determined" if needed == 0.0 else f"{needed:.0f} s more" if np.isfinite(needed) else "move otherwise"
        listed = stds if len(stds) <= 3 else [max(stds, key=lambda s: s.std / s.tolerance)]
        values = ", ".join(f"{factor * s.std:.2g}" if np.isfinite(s.std) else "unknown" for s in listed)
        name = group.replace("_", " ") + (f" {listed[0].label}" if len(stds) > 3 else "")
        rows.append((sensor, name, values, f"{factor * listed[0].tolerance:.2g}", unit, state))
    rows.sort(key=lambda row: row[-1] == "determined")
    weak = sum(row[-1] != "determined" for row in rows)
    title = f"Expected std, from the first {prediction.seconds:.0f} s"
    return Grid(title, ("sensor", "parameter", "std (x, y, z)", "tolerance", "unit", "state"), tuple(rows), weak, 3)


def _advice(f: Follower, prediction: Expectation | None) -> Iterator[str]:
    """What is wrong, and what to do next."""
    late = time.monotonic() - f.arrived
    if f.problem:
        yield f.problem
    yield from f.unread.values()
    if max(f.seconds, late) > SILENT_S:
        yield from (f"{name}: {sentence}" for name, sentence in f.missing.items())
    if late > SILENT_S and not f.problem:
        yield f"Nothing has arrived for {late:.0f} s: the recorder has ended, or its disk is full."
    if f.target is None:
        yield "Standard deviations are predicted with a target; give it, or its rig file, with --target FILE."
        return
    cameras = {name: f.topics[t.name] for name, t in f.sensors.items() if t.kind == "image"}
    if any(a.searched for a in cameras.values()) and not any(a.sees for a in cameras.values()):
        yield f"The target is not in view of {' and '.join(cameras)}; bring it into view."
    if prediction is None and f.topics:
        yield _before_prediction(f)
    elif prediction is not None and prediction.problem:
        yield f"No prediction yet: {prediction.problem}"
        if f.motion.count:
            axis = f.motion.least_turned(np.eye(3))
            yield f"{next(iter(f.sensors))} turned least about its {axis} axis so far; turn about it, too."
    elif prediction is not None:
        yield from _next_motion(f, prediction)
    for name, a in cameras.items():
        if a.seen and (empty := empty_borders(a.cells.tolist())):
            yield f"Move the target into the {' and the '.join(empty)} of the image of {name}."


def _before_prediction(f: Follower) -> str:
    """Why there is no prediction yet."""
    cameras = [f.topics[t.name] for t in f.sensors.values() if t.kind in ("image", "corners")]
    if not cameras:
        return "A prediction needs a camera that sees the target: record its images, or correct the rig file."
    if max(a.seen for a in cameras) < FEWEST_VIEWS:
        return f"Keep moving: a prediction needs {FEWEST_VIEWS} images with the target."
    return "Keep moving: the first prediction is on its way; the first run compiles its code."


def _next_motion(f: Follower, prediction: Expectation) -> Iterator[str]:
    """The motion that the sensor farthest from its tolerances needs."""
    yield from prediction.hidden
    weak = [s for s in prediction.stds if s.needed_s > 0.0 and s.group in MOUNTED_NAMES]
    if not weak:
        yield f"All extrinsics and time offsets are determined after {prediction.seconds:.0f} s."
        return
    worst = max(weak, key=lambda s: s.std / s.tolerance)
    more = f", {worst.needed_s:.0f} s more" if np.isfinite(worst.needed_s) else ""
    if worst.group == TIME_OFFSET.name or not f.motion.count or worst.sensor not in prediction.rotations:
        yield f"Turn and shake the rig faster, to and fro{more}; {worst.sensor} needs it."
        return
    axis = f.motion.least_turned(prediction.rotations[worst.sensor])
    yield f"Turn about the {axis} axis of {worst.sensor}{more}, for its {worst.group} {worst.label}."


# The terminal, and a local page.

REFRESH_S = 0.5
SILENT_S = 5.0  # recorders write a chunk more often
LINE_EVERY_S = 5.0  # between lines where there is no terminal


def follow(root: Path, given: GivenTarget | None, address: tuple[str, int] | None, quiet: bool) -> None:
    """Shows the recording at `root` while it grows, until it is interrupted. address: of the page; None: no page.
    quiet: nothing is printed.

    Raises CalibrationError if the address cannot be used."""
    console, follower = Console(quiet=quiet), Follower(root, given)
    with closing(Page(address)) if address else nullcontext() as page, closing(Solver()) as solver:
        if page is not None:
            console.print(f"Page: http://{page.host}:{page.port}/", markup=False, highlight=False)
            page.show(view(follower, None))
        begins = f"Following {root}, until Ctrl-C. The first run compiles its code, which takes a minute."
        console.print(begins, markup=False, highlight=False)
        with suppress(KeyboardInterrupt):
            _show(follower, solver, page, console)
    console.print(view(follower, solver.latest).line, markup=False, highlight=False)


def _show(follower: Follower, solver: Solver, page: Page | None, console: Console) -> None:
    """Looks and shows, for ever. It rests for as much time as it works, of a processor, which is then half a core."""
    drawn = printed = -inf
    with Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else nullcontext() as live:
        while True:
            begin, worked = time.monotonic(), time.process_time()
            follower.look()
            try:
                solver.offer(follower.coarse_problem)
            except CalibrationError as error:  # such as images of one camera with the same stamp
                follower.problem = str(error)
            if begin - drawn >= REFRESH_S:
                drawn, now = begin, view(follower, solver.latest)
                if page is not None:
                    page.show(now)
                if live is not None:
                    live.update(screen(now, *console.size), refresh=True)
                elif begin - printed >= LINE_EVERY_S:
                    printed = begin
                    console.print(now.line, markup=False, highlight=False)
            time.sleep(max(LOOK_EVERY_S, time.process_time() - worked))
