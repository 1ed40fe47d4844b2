"""Recordings that are folders: tables `imu0/data.csv`, `cam0/corners.csv`, gzip or not, and EuRoC's images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import final

import numpy as np

from icalib.data.checks.imu_halves import ImuHalves
from icalib.data.images.euroc_images import file_payloads, image_files
from icalib.data.images.image_checks import Note, checked_payloads, frames, ignore
from icalib.data.images.images import DecodedImage, Payload
from icalib.data.images.topics import TopicInfo, choose_topic, find_topic
from icalib.data.images.unreadable import VIDEO_FILE
from icalib.data.images.videos import video_payloads, video_stamps, video_topic, videos_in
from icalib.data.measurements import CornerStream, ImuStream, LidarStream, TrackStream, WheelPoses
from icalib.data.messages.lidar_checks import Sieve, sifted
from icalib.data.stamps.sections import S
from icalib.data.stamps.window import WHOLE, Span, Window, cut, stamps_inside
from icalib.data.tables.columns import IMU, IMU_ACCEL, IMU_GYRO, STAMP, TableKind
from icalib.data.tables.corners import group_corners
from icalib.data.tables.numbered import numbered_pictures, stamped_by_rows
from icalib.data.tables.poses import FILES as POSE_FILES
from icalib.data.tables.poses import POSES, PoseReadings, is_tum_text, read_pose_file
from icalib.data.tables.scans import in_seconds, read_scan_stamps, read_scans
from icalib.data.tables.table import Table, holds, named, read_table
from icalib.data.tables.tracks import read_track_stamps, read_tracks
from icalib.data.tables.wheels import RELATIVE_POSES, STAMPS, UNITS, WheelReadings, read_wheel_table
from icalib.errors import RecordingError
from icalib.geometry.targets import Target
from icalib.rig import PLAIN_TABLE, Camera, ImuSensor, Lidar, PoseSensor, TableLayout, TwoSources, Wheels

_CORNERS = TableKind(
    ("t [ns]", "tag id", "corner"),
    ("u [px]", "v [px]"),
    (
        STAMP,
        (r"(tag|marker)(_?id)?|id",),
        (r"corner(_?(id|index))?",),
        (r"u(_?px)?|x(_?px)?",),
        (r"v(_?px)?|y(_?px)?",),
    ),
    (1e-3, 1000.0),
)
_MAX_LISTED = 12


@final
class FolderRecording:
    """A folder of tables and images; those of EuRoC's `mav0` are found, too.

    IMU: t [ns], wx, wy, wz [rad/s], ax, ay, az [m/s^2], which is also EuRoC's `imu0/data.csv`. Corners: t [ns], tag id,
    corner (as the target names its points), u, v [px]. Scans of a LiDAR: arrays (`scans`). Wheels: tables
    (`wheels`). Poses: tables, TUM's text (`poses`). Images: the folder `data` beside a `data.csv` of t [ns], file name.
    Kalibr's `cam0/STAMP.png` beside `imu0.csv` is found, too.
    """

    def __init__(self, root: Path, window: Window = WHOLE) -> None:
        self.root = root
        self._window = window
        self._read: list[Path] = []
        self._notes: list[str] = [] if window.is_all else [window.note(str(root))]
        self._pose_sensors: tuple[PoseSensor, ...] = ()

    def use_layouts(self, sensors: Sequence[PoseSensor]) -> None:
        self._pose_sensors = tuple(sensors)

    def topics(self) -> tuple[TopicInfo, ...]:
        found: list[TopicInfo] = []
        for folder in sorted(p for base in self._bases() for p in base.iterdir() if p.is_dir()):
            if (images := self._images(folder)) is not None:
                found.append(images)
            elif (table := _existing(folder, "data.csv")) and holds(table, IMU):
                stamps_ns = read_table(table, IMU).integers[:, 0]
                found.append(_info(f"{folder.name}/data.csv", "table of readings", "imu", stamps_ns))
            if table := _existing(folder, "corners.csv"):
                stamps_ns = np.unique(read_table(table, _CORNERS).integers[:, 0])
                found.append(_info(f"{folder.name}/corners.csv", "table of corners", "corners", stamps_ns))
            if table := _existing(folder, "tracks.csv"):
                name = f"{folder.name}/tracks.csv"
                found.append(_info(name, "table of tracks", "tracks", read_track_stamps(table)))
            found += [_info(f"{folder.name}/{p.name}", *what, self._stamps_of(p)) for p, what in _robot(folder)]
        for table in sorted(p for base in self._bases() for p in base.glob("*.csv")):
            found += _single(table, self._layouts().get(table, PLAIN_TABLE))
        return (*found, *self._videos)

    def stamps(self, topic: str) -> np.ndarray:
        stamps_ns = self._all_stamps(topic)
        if self._window.is_all or not len(stamps_ns):
            return stamps_ns
        return stamps_ns[stamps_inside(self._window, stamps_ns, f"{self.root}/{topic}", self._spans())]

    def _all_stamps(self, topic: str) -> np.ndarray:
        chosen = find_topic(str(self.root), self.topics(), topic)
        if chosen.type == VIDEO_FILE:
            return video_stamps(self.root / chosen.name)
        if chosen.kind == "image":
            folder = next(p for base in self._bases() if (p := base / chosen.name).is_dir())
            return np.array([stamp_ns for stamp_ns, _ in self._pictures(folder)], np.int64)
        if chosen.kind == "imu":
            return read_table(self._locate(chosen.name), IMU).integers[:, 0].copy()
        if chosen.kind == "tracks":
            return read_track_stamps(self._locate(chosen.name))
        if chosen.kind in ("points", "wheels", "pose"):
            return self._stamps_of(self._locate(chosen.name))
        return np.unique(read_table(self._locate(chosen.name), _CORNERS).integers[:, 0])

    def image_topic(self, camera: Camera) -> str:
        return choose_topic(str(self.root), self._seen(), "image", camera.name, camera.topic).name

    def payloads(self, topic: str) -> Iterator[Payload]:
        chosen = find_topic(str(self.root), self._seen(), topic)
        if chosen.type == VIDEO_FILE:
            return self._frames(self.root / chosen.name)
        name = chosen.name
        folder = next(p for base in self._bases() if (p := base / name).is_dir())
        if (folder / "data.csv").is_file():
            self._remember(folder / "data.csv")
        files = self._pictures(folder, self._note)
        if files and not self._window.is_all:
            stamps_ns = np.array([stamp_ns for stamp_ns, _ in files], np.int64)
            inside = stamps_inside(self._window, stamps_ns, str(folder), self._spans())
            files = [file for file, used in zip(files, inside.tolist(), strict=True) if used]
        return checked_payloads(file_payloads(files, str(folder), self._note), str(folder), self._note)

    def _frames(self, video: Path) -> Iterator[Payload]:
        """Those of a video in the window."""
        self._remember(video)
        found = video_payloads(video, str(video))
        if not self._window.is_all:
            stamps_ns = video_stamps(video)
            inside = stamps_inside(self._window, stamps_ns, str(video), self._spans())
            used = set(stamps_ns[inside].tolist())
            found = (p for p in found if p.stamp_ns in used)
        return checked_payloads(found, str(video), self._note)

    def images(self, topic: str) -> Iterator[DecodedImage]:
        return frames(self.payloads(topic), f"{self.root}/{topic}", self._note)

    def imu(self, sensor: ImuSensor) -> ImuStream | ImuHalves:
        if isinstance(sensor.path, TwoSources):
            layout = TableLayout(time_unit=sensor.layout.time_unit)
            gyro = read_table(self._locate(sensor.path.gyro), IMU_GYRO, layout, self._note)
            accel = read_table(self._locate(sensor.path.accel), IMU_ACCEL, layout, self._note)
            self._remember(gyro.path)
            self._remember(accel.path)
            (gyro_ns, rates), (accel_ns, forces) = (self._inside(table) for table in (gyro, accel))
            return ImuHalves(sensor.name, gyro_ns, rates, accel_ns, forces)
        table = read_table(self._locate(sensor.path), IMU, sensor.layout, self._note)
        self._remember(table.path)
        stamps_ns, values = table.integers[:, 0].copy(), table.decimals
        return self._part(ImuStream(sensor.name, stamps_ns, values[:, :3].copy(), values[:, 3:].copy()), table.path)

    def has_corners(self, camera: Camera) -> bool:
        # Where there are neither corners nor images, the sentence on the missing table is the better one.
        return self._find(camera.path) is not None or not self._seen()

    def corners(self, camera: Camera, target: Target) -> CornerStream:
        layout = camera.layout if camera.tracks is None else TableLayout(time_unit=camera.layout.time_unit)
        table = read_table(self._locate(camera.path), _CORNERS, layout, self._note)
        self._remember(table.path)
        stamps, tag, corner = (table.integers[:, k].copy() for k in range(3))
        found = group_corners(camera.name, str(table.path), stamps, tag, corner, table.decimals, target)
        return self._part(found, table.path)

    def sees(self, camera: Camera) -> bool:
        return self._find(camera.path) is not None or len(self._seen()) > 0

    def tracks(self, camera: Camera) -> TrackStream:
        assert camera.tracks is not None
        path = self._locate(camera.tracks, "tracks")
        self._remember(path)
        return self._part(read_tracks(camera.name, path, camera.resolution, camera.layout, self._note), path)

    def lidar(self, sensor: Lidar) -> LidarStream:
        path = self._locate(sensor.path)
        self._remember(path)
        sieve, what = Sieve(sensor.min_range_m, sensor.max_range_m), f"{path} ({sensor.name})"
        stream, notes = in_seconds(self._part(read_scans(sensor.name, path), path), sensor, what)
        stream = sifted(stream, sieve)
        for note in (*notes, sieve.note(what)):
            if note:
                self._note(note)
        return stream

    def wheels(self, sensor: Wheels) -> WheelReadings | WheelPoses:
        path = self._locate(sensor.path)
        self._remember(path)
        return self._part(read_wheel_table(sensor, path, self._note), path)

    def poses(self, sensor: PoseSensor) -> PoseReadings:
        if sensor.frames is not None:
            raise RecordingError(
                f"{self.root} is a folder, but `frames` of {sensor.name} needs the transforms (/tf) of a bag; "
                "give the bag, or remove `frames` from the rig file."
            )
        path = self._locate(sensor.path)
        self._remember(path)
        return self._part(read_pose_file(sensor.name, path, sensor.layout, self._note), path)

    def where(self, sensor: ImuSensor | Camera | Lidar | Wheels | PoseSensor) -> str:
        if isinstance(sensor, Camera) and not self.has_corners(sensor):
            return f"{self.root / self.image_topic(sensor)}"
        if isinstance(sensor.path, TwoSources):
            return f"{self._locate(sensor.path.gyro)} and {self._locate(sensor.path.accel)}"
        return str(self._locate(sensor.path))

    def files(self) -> list[Path]:
        return list(self._read)

    def notes(self) -> tuple[str, ...]:
        return tuple(self._notes)

    def _note(self, sentence: str) -> None:
        if sentence not in self._notes:
            self._notes.append(sentence)

    def _part(self, stream: S, path: Path) -> S:
        """What is inside the window."""
        return stream if self._window.is_all else cut(self._window, stream, f"{path} ({stream.name})", self._spans())

    def _inside(self, table: Table) -> tuple[np.ndarray, np.ndarray]:
        """Stamps and decimals of the rows inside the window."""
        stamps_ns = table.integers[:, 0].copy()
        if self._window.is_all:
            return stamps_ns, table.decimals
        inside = stamps_inside(self._window, stamps_ns, str(table.path), self._spans())
        return stamps_ns[inside], table.decimals[inside]

    def _spans(self) -> list[Span]:
        """First and last stamp of each topic."""
        topics = self.topics()
        return [(t.first_ns, t.last_ns) for t in topics if t.first_ns is not None and t.last_ns is not None]

    def _bases(self) -> list[Path]:
        return [p for p in (self.root, self.root / "mav0") if p.is_dir()]

    def _image_topics(self) -> tuple[TopicInfo, ...]:
        folders = sorted(p for base in self._bases() for p in base.iterdir() if p.is_dir())
        return tuple(topic for p in folders if (topic := self._images(p)) is not None)

    def _images(self, folder: Path) -> TopicInfo | None:
        stamps = [stamp for stamp, _ in self._pictures(folder)]
        return _info(folder.name, "images", "image", np.array(stamps, np.int64)) if stamps else None

    def _pictures(self, folder: Path, note: Note = ignore) -> list[tuple[int, Path]]:
        """Stamps [ns] and files of the images of a folder. Pictures that have but numbers have the stamps of the only
        table of poses."""
        if numbered := numbered_pictures(folder):
            tables = self._pose_tables()
            if len(tables) == 1:
                (table,) = tables
                return stamped_by_rows(numbered, table, self._layouts().get(table, PLAIN_TABLE), note)
        return image_files(folder, note)

    def _pose_tables(self) -> set[Path]:
        """Those that are told by what they hold, and those of the rig file's pose sensors."""
        folders = [p for base in self._bases() for p in base.iterdir() if p.is_dir()]
        found = {table for p in folders for table, (_, kind) in _robot(p) if kind == "pose"}
        found |= {p for base in self._bases() for p in base.glob("*.csv") if named(p, POSES)}
        return found | self._layouts().keys()

    def _layouts(self) -> dict[Path, TableLayout]:
        """That of each table of the rig file's pose sensors."""
        found = [(self._find(s.path), s.layout) for s in self._pose_sensors if s.frames is None]
        return {path: layout for path, layout in found if path is not None}

    def _stamps_of(self, table: Path) -> np.ndarray:
        """(N,) int64 ns of scans, wheels or poses."""
        if (layout := self._layouts().get(table)) is not None:
            return read_pose_file(table.parent.name, table, layout).stamps_ns
        return _stamps(table)

    @cached_property
    def _videos(self) -> tuple[TopicInfo, ...]:
        files = {p: None for base in self._bases() for p in videos_in(base)}
        return tuple(video_topic(p, str(p.relative_to(self.root))) for p in files)

    def _seen(self) -> tuple[TopicInfo, ...]:
        """Images in folders and videos."""
        return (*self._image_topics(), *self._videos)

    def _remember(self, path: Path) -> None:
        if path not in self._read:
            self._read.append(path)

    def _find(self, path_hint: str) -> Path | None:
        plain = path_hint.removesuffix(".gz")
        names = (path_hint, plain, plain + ".gz")
        if len(parts := Path(plain).parts) == 2 and parts[1] != "corners.csv":
            names += (f"{parts[0]}.csv",)  # as Kalibr's bagcreater takes them
        return next(
            (p for folder in (self.root, self.root / "mav0") for n in names if (p := folder / n).is_file()), None
        )

    def _locate(self, path_hint: str, field: str = "path") -> Path:
        if found := self._find(path_hint):
            return found
        plain = path_hint.removesuffix(".gz")
        raise RecordingError(
            f"{self.root} has no {plain} (nor {plain}.gz); {self._listing()}; set `{field}` of the sensor in the rig "
            "file."
        )

    def _listing(self) -> str:
        found = sorted(str(p.relative_to(self.root)) for p in self.root.rglob("*") if p.is_file())
        if not found:
            return "the folder holds no files"
        more = f" and {len(found) - _MAX_LISTED} more" if len(found) > _MAX_LISTED else ""
        return f"it holds {', '.join(found[:_MAX_LISTED])}{more}"


def has_named_table(folder: Path) -> bool:
    """Whether a table of an IMU or a pose sensor, whose header says so, lies in `folder` itself."""
    return any(named(p, kind) for p in sorted(folder.glob("*.csv")) for kind in (IMU, POSES))


def _existing(folder: Path, name: str) -> Path | None:
    return next((p for p in (folder / name, folder / f"{name}.gz") if p.is_file()), None)


def _single(table: Path, layout: TableLayout) -> list[TopicInfo]:
    """Of an IMU or a pose sensor, where a table beside the folders names their columns."""
    for kind, what in ((IMU, ("table of readings", "imu")), (POSES, ("table of poses", "pose"))):
        if named(table, kind):
            return [_info(table.name, *what, read_table(table, kind, layout).integers[:, 0])]
    return []


def _robot(folder: Path) -> Iterator[tuple[Path, tuple[str, str]]]:
    """Tables of LiDARs, wheels and pose sensors with their type and kind."""
    names = {f"{m}.csv": (f"table of {m}", "wheels") for m in (*UNITS, "twist", "poses")}
    names |= {"scans.npz": ("scans", "points")}
    names |= {name: ("table of poses", "pose") for name in POSE_FILES[1:]}
    for name, what in names.items():
        if table := _existing(folder, name):
            yield table, ("table of poses", "pose") if _is_poses(table) else what


def _is_poses(table: Path) -> bool:
    """Whether these are poses in a frame, and not relative ones of wheels."""
    return table.name.startswith("poses.") and (is_tum_text(table) or holds(table, POSES))


def _stamps(table: Path) -> np.ndarray:
    """(N,) int64 ns of scans, wheels or poses."""
    if table.suffix == ".npz":
        return read_scan_stamps(table)
    if _is_poses(table):
        return read_pose_file(table.parent.name, table).stamps_ns
    kind = RELATIVE_POSES if holds(table, RELATIVE_POSES) else STAMPS
    return read_table(table, kind).integers[:, 0].copy()


def _info(name: str, kind_of_file: str, kind: str, stamps_ns: np.ndarray) -> TopicInfo:
    return TopicInfo(name, kind_of_file, kind, len(stamps_ns), int(stamps_ns.min()), int(stamps_ns.max()))
