"""Writes simulated recordings as tables and bags."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import yaml

from icalib.base.files import below, staged, write_new, write_text
from icalib.data.measurements import CornerStream, ImuStream, TrackStream
from icalib.errors import RecordingError, RigError
from icalib.geometry.targets import Target
from icalib.tools.simulation.filming import Film, Shot
from icalib.tools.simulation.output import IMAGE, IMU, IMU_TOPIC, BagForm, BagWriter, package, write_table
from icalib.tools.simulation.recording import Simulation, Truth
from icalib.tools.simulation.rendering import Imaging
from icalib.tools.simulation.rigs import rig_text
from icalib.tools.simulation.scenario import BagTopic, Scenario, SimRecord, SimSensor

# Writes films as bags of ROS 1 and ROS 2 by rosbags (extra `bags`), or in EuRoC's layout (extra `images`).

Form = BagForm | Literal["euroc"]
FORMS: tuple[Form, ...] = ("ros1", "mcap", "sqlite3", "euroc")
Reading = tuple[int, list[float]]  # stamp [ns]; gyro, accel


class _Sink(AbstractContextManager["_Sink"], Protocol):
    """A recording that is being written. received_ns: instant of reception on the IMU's clock [ns]."""

    def shot(self, shot: Shot, received_ns: int) -> None: ...

    def reading(self, reading: Reading) -> None: ...


def write_film(film: Film, paths: Mapping[Form, Path], workers: int | None = None) -> None:
    """Writes `film` in each form of `paths`. Each image is rendered once, and only a few are in memory.

    ros1: a file; mcap and sqlite3: folders of ROS 2; euroc: a folder with `mav0`, images as PNG. Images of cam0 have
    the topic `/cam0/image_raw`, mono8. workers: threads, None for all cores. Raises RecordingError if a path exists,
    CalibrationError if a package is missing.
    """
    for path in paths.values():
        if path.exists():
            raise RecordingError(f"{path} exists already; remove it, or choose another path.")
    cameras = [camera.name for camera in film.scenario.cameras]
    with ExitStack() as stack:
        sinks = [stack.enter_context(_sink(form, path, cameras)) for form, path in paths.items()]
        for received_ns, event in _in_time(film, workers):
            for sink in sinks:
                if isinstance(event, Shot):
                    sink.shot(event, received_ns)
                else:
                    sink.reading(event)


def _in_time(film: Film, workers: int | None) -> Iterator[tuple[int, Shot | Reading]]:
    """Images and readings in order of time, each with its instant on the IMU's clock [ns]."""
    values = np.concatenate([film.imu.gyro, film.imu.accel], axis=1).tolist()
    readings = ((stamp, (stamp, row)) for stamp, row in zip(film.imu.stamps_ns.tolist(), values, strict=True))
    shots = ((film.truth.imu_clock_origin_ns + round(shot.seconds * 1e9), shot) for shot in film.shots(workers))
    return heapq.merge(readings, shots, key=lambda event: event[0])


def _sink(form: Form, path: Path, cameras: list[str]) -> _Sink:
    return _Folder(path, cameras) if form == "euroc" else _FilmBag(form, path, cameras)


class _FilmBag(BagWriter):
    """A bag of images and readings."""

    def __init__(self, form: BagForm, path: Path, cameras: list[str]) -> None:
        super().__init__(form, path, {IMU_TOPIC: IMU} | {_image_topic(name): IMAGE for name in cameras})

    def shot(self, shot: Shot, received_ns: int) -> None:
        self.write(_image_topic(shot.camera), self.image(shot.stamp_ns, shot.camera, shot.pixels), received_ns)

    def reading(self, reading: Reading) -> None:
        self.write(IMU_TOPIC, self.imu(*reading), reading[0])


class _Folder:
    """A folder in EuRoC's layout; readings are written with all digits."""

    def __init__(self, path: Path, cameras: list[str]) -> None:
        self._cv2 = package("cv2", "images")
        self._root = path / "mav0"
        self._stack = ExitStack()
        self._headers = {"imu0": "#timestamp [ns],w_x [rad s^-1],w_y,w_z,a_x [m s^-2],a_y,a_z"}
        self._headers |= {name: "#timestamp [ns],filename" for name in cameras}
        self._tables: dict[str, Any] = {}

    def __enter__(self) -> _Folder:
        for name, header in self._headers.items():
            (below(self._root, name) / ("" if name == "imu0" else "data")).mkdir(parents=True)
            table = (self._root / name / "data.csv").open("w", encoding="utf-8")
            self._tables[name] = self._stack.enter_context(table)
            table.write(header + "\n")
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def shot(self, shot: Shot, received_ns: int) -> None:
        name = f"{shot.stamp_ns}.png"
        done, data = self._cv2.imencode(".png", shot.pixels)
        assert done
        (self._root / shot.camera / "data" / name).write_bytes(data.tobytes())
        self._tables[shot.camera].write(f"{shot.stamp_ns},{name}\n")

    def reading(self, reading: Reading) -> None:
        stamp_ns, values = reading
        self._tables["imu0"].write(",".join([str(stamp_ns), *(repr(v) for v in values)]) + "\n")


def _image_topic(camera: str) -> str:
    return f"/{camera}/image_raw"


# Writes a simulated recording as a folder of tables with its truth; the format is described in docs/simulation.md.

_TRUTH_HEADER = """\
# Truth of a simulated recording, in SI units: p_imu = T_imu_sensor p_sensor, t_imu = t_sensor + time_offset.
# Planes: [nx, ny, nz, d] in the world, n . p = d. The trajectory and the points of the tracks are in truth.npz.
"""


def check_absent(path: Path) -> None:
    """Raises RecordingError if `path` exists, as recordings are never overwritten."""
    if path.exists():
        raise RecordingError(f"{path} exists already; remove it, or choose another path.")


@contextmanager
def atomic_output(path: Path) -> Iterator[Path]:
    """Context with a temporary path beside `path`. It is renamed to `path` at the end, and removed if anything fails.

    Raises RecordingError if `path` exists or cannot be written.
    """
    check_absent(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with staged(path.parent) as place:
            yield place / path.name
            check_absent(path)
            (place / path.name).rename(path)
    except OSError as error:
        raise RecordingError(f"{path} cannot be written ({error.strerror or error}); choose another folder.") from None


def write_tables(
    simulation: Simulation, seed: int, path: Path, progress: Callable[[float], None] = lambda done: None
) -> tuple[str, ...]:
    """Writes the measurements as tables, their truth, and their rig file, to the new folder `path`, atomically.

    Returns an empty tuple, as nothing is left out, see `write_sensors`. Raises RecordingError if `path` exists or
    cannot be written, CalibrationError if a sensor's name is no valid folder name.
    """
    measured = simulation.measurements
    assert measured.imu is not None  # of every scenario
    with atomic_output(path) as folder:
        steps: list[Callable[[], None]] = [partial(_write_imu, below(folder, measured.imu.name), measured.imu)]
        target = simulation.scenario.target
        steps += [partial(write_corners, below(folder, c.name), c, target) for c in measured.cameras]
        steps += [partial(_write_tracks, below(folder, t.name), t) for t in measured.tracks]
        for sensor in simulation.scenario.sensors:
            steps.append(partial(_record(simulation, sensor).write_table, below(folder, sensor.name)))
        steps += [partial(write_truth, simulation, seed, folder)]
        for i, step in enumerate(steps):
            step()
            progress((i + 1) / len(steps))
    return ()


def write_truth(simulation: Simulation, seed: int, folder: Path, topics: Iterable[str] | None = None) -> None:
    """Writes truth.yaml, truth.npz and rig.yaml to the existing folder `folder`. topics: see `rig_text`."""
    write_text(folder / "rig.yaml", rig_text(simulation.scenario, topics))
    truth = simulation.truth
    text = yaml.safe_dump(_plain_truth(simulation.scenario, truth, seed), sort_keys=False, default_flow_style=None)
    (folder / "truth.yaml").write_text(_TRUTH_HEADER + text, encoding="utf-8")
    trajectory = {name: getattr(truth, name) for name in ("position", "velocity", "gyro_bias", "accel_bias", "points")}
    stamps_ns = truth.imu_clock_origin_ns + np.round(truth.seconds * 1e9).astype(np.int64)
    np.savez(folder / "truth.npz", stamps_ns=stamps_ns, rotation=truth.R_world_imu, **trajectory)


def _plain_truth(scenario: Scenario, truth: Truth, seed: int) -> dict[str, Any]:
    sensors: dict[str, Any] = {
        "imu0": {
            "type": "imu",
            "gyro_bias": truth.gyro_bias[0].tolist(),
            "accel_bias": truth.accel_bias[0].tolist(),
            **_plain(truth.values["imu0"]),
            **({} if scenario.imu_cutoff_hz is None else {"cutoff": scenario.imu_cutoff_hz}),
        }
    }
    for c in scenario.cameras:
        parameters = {"intrinsics": list(map(float, c.intrinsics)), "distortion": list(map(float, c.distortion))}
        parameters |= {"shutter": {"rolling": c.rolling, "readout": c.readout_s}} if c.readout_s else {}
        sensors[c.name] = _mounted(truth, c.name, "camera") | {"model": c.model} | parameters
    for s in scenario.sensors:
        true = s.true_parameters()
        sensors[s.name] = {**_mounted(truth, s.name, s.sensor_type), **true.entries, **_plain(true.values)}
    plain: dict[str, Any] = {"seed": seed, "gravity": truth.gravity.tolist(), "sensors": sensors}
    if scenario.board:
        plain |= {"T_world_bodies": truth.T_world_bodies.tolist(), "target_size": truth.target_size}
    return plain | {"planes": truth.planes.tolist()}


def _plain(values: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Parameters as plain data by name, those of one number as a number."""
    return {name: v.tolist() if v.size > 1 else float(v[0]) for name, v in values.items()}


def _mounted(truth: Truth, name: str, kind: str) -> dict[str, Any]:
    return {
        "type": kind,
        "T_imu_sensor": truth.T_imu_sensor[name].tolist(),
        "time_offset": float(truth.time_offset[name]),
    }


def _write_imu(folder: Path, imu: ImuStream) -> None:
    header = "t [ns],wx [rad/s],wy [rad/s],wz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"
    write_table(folder / "data.csv", header, imu.stamps_ns, imu.gyro, imu.accel)


def write_corners(folder: Path, corners: CornerStream, target: Target) -> None:
    """Writes the table of a camera's corners to the new folder `folder`."""
    names = target.point_identity(corners.point)
    stamps = corners.stamps_ns[corners.image]
    write_table(folder / "corners.csv", "t [ns],tag id,corner,u [px],v [px]", stamps, *names, corners.uv)


def _write_tracks(folder: Path, tracks: TrackStream) -> None:
    stamps = tracks.stamps_ns[tracks.image]
    write_table(folder / "tracks.csv", "t [ns],feature,u [px],v [px]", stamps, tracks.feature, tracks.uv)


# Writes a simulated recording as a bag with the messages of the sensors' drivers: ROS 1, or MCAP of ROS 2.

Event = tuple[int, str, Callable[[BagWriter], Any]]  # instant on the IMU's clock [ns], topic, maker of the message
_EXPOSURE_S = 0.004
_AT_A_TIME = 10_000  # readings that are converted to Python numbers at once, which take ten times the memory


def write_sensors(
    simulation: Simulation, seed: int, path: Path, progress: Callable[[float], None] = lambda done: None
) -> tuple[str, ...]:
    """Writes an MCAP bag, its truth and its rig file to the new folder `path`, atomically. If `path` ends with .bag,
    it is a ROS 1 bag, with only the rig file beside it, as `run.rig.yaml`.

    Topics are /imu0 (Imu), those of `SimSensor.record`, and /NAME/image_raw (Image, mono8), which shows the target,
    or the room if there is no target. Returns sentences on data that were left out. Raises RecordingError if `path`
    exists or cannot be written, CalibrationError if a package is missing, RigError for a board that is not flat.
    """
    if any(simulation.scenario.bow):
        raise RigError("boards are rendered flat; set the scenario's bow to zero.")
    ros1, rig = path.suffix == ".bag", path.with_suffix(".rig.yaml")
    if ros1:
        check_absent(rig)
    topics, streams, notes = _streams(simulation, seed)
    last_ns = simulation.truth.imu_clock_origin_ns + int(simulation.truth.seconds[-1] * 1e9)
    span_ns = max(last_ns - simulation.truth.imu_clock_origin_ns, 1)
    with atomic_output(path) as place:
        with BagWriter("ros1" if ros1 else "mcap", place, topics) as bag:
            for at_ns, topic, make in heapq.merge(*streams, key=lambda event: event[0]):
                bag.write(topic, make(bag), at_ns)
                progress(1.0 - (last_ns - at_ns) / span_ns)
        if not ros1:
            write_truth(simulation, seed, place, topics)
    if ros1:
        write_new(rig, rig_text(simulation.scenario, topics))
        notes += (f"the rig file of the bag is {rig}.",)
    return notes


def _streams(simulation: Simulation, seed: int) -> tuple[dict[str, str], list[Iterator[Event]], tuple[str, ...]]:
    """The message type of each topic, the events of each stream, and sentences on sensors without messages."""
    measured = simulation.measurements
    assert measured.imu is not None  # of every scenario
    topics, streams, notes = {IMU_TOPIC: IMU}, [_readings(measured.imu)], []
    middle_ns = simulation.truth.imu_clock_origin_ns + int(0.5e9 * simulation.truth.seconds[-1])
    for sensor in simulation.scenario.sensors:
        topic = _record(simulation, sensor).topic
        if isinstance(topic, str):
            notes.append(topic)
            continue
        topics[topic.name] = topic.message
        streams.append(_on_topic(topic, sensor.clock_rate_ppm, middle_ns))
    if simulation.scenario.board or simulation.scenario.room:
        topics |= {f"/{camera.name}/image_raw": IMAGE for camera in simulation.scenario.cameras}
        streams.append(_images(simulation, seed))
    elif simulation.scenario.cameras:
        notes.append("images show targets or a room, and the scenario has neither, so no images are written.")
    return topics, streams, tuple(notes)


def _record(simulation: Simulation, sensor: SimSensor) -> SimRecord:
    """Table and messages of a sensor's measurements."""
    offset_ns = round(simulation.truth.time_offset[sensor.name] * 1e9)
    return sensor.record(simulation.measurements.streams[sensor.name], offset_ns)


def _on_topic(topic: BagTopic, rate_ppm: float, middle_ns: int) -> Iterator[Event]:
    """The events at their instants on the IMU's clock: those of the topic have its time offset, but not its rate."""
    return ((at_ns + round(1e-6 * rate_ppm * (at_ns - middle_ns)), topic.name, make) for at_ns, make in topic.events)


def _readings(imu: ImuStream) -> Iterator[Event]:
    for first in range(0, len(imu.stamps_ns), _AT_A_TIME):
        some = slice(first, first + _AT_A_TIME)
        values = np.concatenate([imu.gyro[some], imu.accel[some]], axis=1).tolist()
        for stamp_ns, row in zip(imu.stamps_ns[some].tolist(), values, strict=True):
            yield stamp_ns, IMU_TOPIC, lambda bag, stamp_ns=stamp_ns, row=row: bag.imu(stamp_ns, row)


def _images(simulation: Simulation, seed: int) -> Iterator[Event]:
    """Events of all images, which are rendered on all cores, a few of them ahead."""
    imu, truth = simulation.measurements.imu, simulation.truth
    assert imu is not None  # of every scenario
    for shot in Film(simulation.scenario, seed, Imaging(blur_px=0.8, noise=2.0), _EXPOSURE_S, imu, truth).shots():
        yield (
            truth.imu_clock_origin_ns + round(shot.seconds * 1e9),
            f"/{shot.camera}/image_raw",
            lambda bag, shot=shot: bag.image(shot.stamp_ns, shot.camera, shot.pixels),
        )
