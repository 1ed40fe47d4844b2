"""Writes films as bags of ROS 1 and ROS 2 by rosbags (extra `bags`), or in EuRoC's layout (extra `images`)."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from icalib.base.files import below
from icalib.errors import RecordingError
from icalib.tools.simulation.images.filming import Film, Shot
from icalib.tools.simulation.output import IMAGE, IMU, IMU_TOPIC, BagForm, BagWriter, package

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
