"""A folder of tables, images and videos as a recording."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import final

import numpy as np

from icalib.base.files import CLOUD_SUFFIXES, VIDEO_FILE
from icalib.base.remark import Remark
from icalib.data.images import (
    SUFFIXES,
    Note,
    Payload,
    are_most,
    checked_payloads,
    file_payloads,
    ignore,
    image_files,
    pictures_in,
    stamp_table,
    stamped_by_name,
    video_payloads,
    video_stamps,
    video_topic,
    videos_in,
)
from icalib.data.messages import TopicInfo, choose_topic, find_topic, type_not_read
from icalib.data.recording import PART_BYTES, NewPart, Recording
from icalib.data.stamps import WHOLE_RECORDING, Window
from icalib.data.tables import (
    StampsOfRows,
    TableFile,
    files_in,
    named_tables,
    numbered_pictures,
    rows_of,
    stamped_by_rows,
)
from icalib.errors import RecordingError
from icalib.rig import PLAIN_TABLE, TableLayout
from icalib.sensors.sensor import Sensor

# Recordings that are folders: tables such as `imu0/data.csv` and `cam0/corners.csv` (also gzip), images, videos.

_MAX_LISTED = 12
_OF_IMAGES = ("data.csv", "data.csv.gz")  # tables of stamps, in folders with images


@final
class FolderRecording(Recording):
    """A folder with tables, images and videos, directly or in its subfolder `mav0` (EuRoC).

    Each subfolder belongs to a sensor and contains files that kinds of sensors declare (`data.tables.files`), such as
    `data.csv` of an IMU. Images are in its subfolder `data`, beside a `data.csv` with t [ns], file name. The layout of
    Kalibr, `cam0/STAMP.png` and `imu0.csv`, is supported, too.
    """

    def __init__(self, root: Path, window: Window = WHOLE_RECORDING) -> None:
        super().__init__(root, window)
        if not window.is_all:
            self.note(window.note(str(root)))

    def topics(self) -> tuple[TopicInfo, ...]:
        topics: list[TopicInfo] = []
        for folder in sorted(p for base in self._bases() for p in base.iterdir() if p.is_dir()):
            images = self._images(folder)
            topics += [] if images is None else [images]
            for path, declared in files_in(folder):
                if images is None or path.name not in _OF_IMAGES:
                    topics.append(self._info(path, f"{folder.name}/{path.name.removesuffix('.gz')}", declared))
        for base in self._bases():
            for path, declared in _top_tables(base).items():
                topics.append(self._info(path, path.name.removesuffix(".gz"), declared))
        return (*topics, *self._videos, *self._unread)

    def stamps(self, topic: str) -> np.ndarray:
        stamps_ns = self._all_stamps(topic)
        if self.window.is_all or not len(stamps_ns):
            return stamps_ns
        return stamps_ns[self._inside(stamps_ns, f"{self.root}/{topic}")]

    def _all_stamps(self, topic: str) -> np.ndarray:
        chosen = find_topic(str(self.root), self.topics(), topic)
        if chosen.type == VIDEO_FILE:
            return video_stamps(self.root / chosen.name)
        if chosen.kind == "image":
            folder = next(p for base in self._bases() if (p := base / chosen.name).is_dir())
            return np.array([stamp_ns for stamp_ns, _ in self._pictures(folder)], np.int64)
        path = self._locate(chosen.name)
        tables = _top_tables(path.parent) if path.parent in self._bases() else dict(files_in(path.parent))
        return self._stamps_of(path, tables[path])

    def image_topic(self, sensor: str, given: str | None) -> str:
        return choose_topic(str(self.root), self.image_topics(), sensor, given, "image").name

    def payloads(self, topic: str) -> Iterator[Payload]:
        chosen = find_topic(str(self.root), self.image_topics(), topic)
        if chosen.type == VIDEO_FILE:
            return self._frames(self.root / chosen.name)
        name = chosen.name
        folder = next(p for base in self._bases() if (p := base / name).is_dir())
        if (folder / "data.csv").is_file():
            self._remember(folder / "data.csv")
        files = self._pictures(folder, self.note)
        if files and not self.window.is_all:
            stamps_ns = np.array([stamp_ns for stamp_ns, _ in files], np.int64)
            inside = self._inside(stamps_ns, str(folder))
            files = [file for file, used in zip(files, inside.tolist(), strict=True) if used]
        return checked_payloads(file_payloads(files, str(folder), self.note), str(folder), self.note)

    def _frames(self, video: Path) -> Iterator[Payload]:
        """Checked frames of a video in the time window."""
        self._remember(video)
        if (table := stamp_table(video)) is not None:
            self._remember(table)
            if table.stem != video.stem:
                sentence = f"{video}: its frames have the stamps of {table.name}, a table with as many rows."
                self.note(Remark("video_stamps_from_table", sentence))
        frames = video_payloads(video, str(video))
        if not self.window.is_all:
            stamps_ns = video_stamps(video)
            inside = self._inside(stamps_ns, str(video))
            used = set(stamps_ns[inside].tolist())
            frames = (p for p in frames if p.stamp_ns in used)
        return checked_payloads(frames, str(video), self.note)

    def find(self, path: str) -> Path | None:
        plain = path.removesuffix(".gz")
        names = (path, plain, plain + ".gz")
        if len(parts := Path(plain).parts) == 2 and parts[1] != "corners.csv":
            names += (f"{parts[0]}.csv",)  # layout of Kalibr's bagcreater
        return next(
            (p for folder in (self.root, self.root / "mav0") for n in names if (p := folder / n).is_file()), None
        )

    def table(self, sensor: Sensor, path: str, field: str = "path") -> Path:
        table = self._locate(path, field)
        self._remember(table)
        return table

    def image_topics(self) -> tuple[TopicInfo, ...]:
        """Topics of image folders and videos."""
        folders = sorted(p for base in self._bases() for p in base.iterdir() if p.is_dir())
        return (*(topic for p in folders if (topic := self._images(p)) is not None), *self._videos)

    def _bases(self) -> list[Path]:
        return [p for p in (self.root, self.root / "mav0") if p.is_dir()]

    def _images(self, folder: Path) -> TopicInfo | None:
        stamps = [stamp for stamp, _ in self._pictures(folder)]
        return TopicInfo(folder.name, "images", "image", len(stamps), min(stamps), max(stamps)) if stamps else None

    def _pictures(self, folder: Path, note: Note = ignore) -> list[tuple[int, Path]]:
        """Stamps [ns] and files of the images of a folder. Images with numbers in place of stamps take the stamps of
        the rows of a table, if exactly one table can provide them."""
        if numbered := numbered_pictures(folder, note):
            tables = self._tables_with_rows()
            if len(tables) == 1:
                ((path, (rows, layout)),) = tables.items()
                return stamped_by_rows(numbered, path, lambda: rows(path, layout, note), note)
        return image_files(folder, note)

    def _tables_with_rows(self) -> dict[Path, tuple[StampsOfRows, TableLayout]]:
        """Tables whose rows can provide stamps for images, detected ones and those of the rig file: the function that
        reads the stamps, and the layout."""
        tables = [table for base in self._bases() for table in _top_tables(base).items()]
        for folder in (p for base in self._bases() for p in base.iterdir() if p.is_dir()):
            tables += files_in(folder)
        plain = [(path, declared, PLAIN_TABLE) for path, declared in tables]
        kinds = [(rows_of(s.sensor_type), s) for s in self._sensors]
        given = [(p, of, layout) for of, s in kinds if of for p, layout in self._layouts([s]).items()]
        return {path: (declared.rows, layout) for path, declared, layout in plain + given if declared.rows is not None}

    def _layouts(self, sensors: Sequence[Sensor]) -> dict[Path, TableLayout]:
        """Layouts of the tables of `sensors`, those of `use_layouts`."""
        given = [(getattr(s, "path", ""), getattr(s, "layout", PLAIN_TABLE)) for s in sensors]
        paths = [(path, layout) for of, layout in given for path in ((of,) if isinstance(of, str) else astuple(of))]
        return {table: layout for path, layout in paths if (table := self.find(path)) is not None}

    def _stamps_of(self, path: Path, declared: TableFile) -> np.ndarray:
        """(N,) int64 ns: stamps of a table."""
        return declared.stamps(path, self._layouts(self._sensors).get(path, PLAIN_TABLE))

    def _info(self, path: Path, name: str, declared: TableFile) -> TopicInfo:
        """The topic of a table. If it cannot be read as it is, its count is 1, so that later reading raises the
        error."""
        try:
            stamps_ns = self._stamps_of(path, declared)
        except RecordingError:
            return TopicInfo(name, declared.type, declared.kind, 1, None, None)
        first, last = int(stamps_ns.min()), int(stamps_ns.max())
        return TopicInfo(name, declared.type, declared.kind, len(stamps_ns), first, last)

    @cached_property
    def _videos(self) -> tuple[TopicInfo, ...]:
        files = {p: None for base in self._bases() for p in videos_in(base)}
        return tuple(video_topic(p, str(p.relative_to(self.root))) for p in files)

    @cached_property
    def _unread(self) -> tuple[TopicInfo, ...]:
        """Files of other sensors that icalib cannot read (`UnreadType`), by folder and ending."""
        files = [p for base in self._bases() for pattern in ("*", "*/*") for p in base.glob(pattern)]
        counts = Counter(str(p.relative_to(self.root).parent / f"*{p.suffix.lower()}") for p in files if p.suffix)
        return tuple(
            TopicInfo(name, f"{Path(name).suffix} files", "", count, None, None)
            for name, count in sorted(counts.items())
            if type_not_read(f"{Path(name).suffix} files")
        )

    def _locate(self, path_hint: str, field: str = "path") -> Path:
        if table := self.find(path_hint):
            return table
        plain = path_hint.removesuffix(".gz")
        raise RecordingError(
            f"{self.root} has no {plain} (nor {plain}.gz); {self._listing()}; set `{field}` of the sensor in the rig "
            "file."
        )

    def _listing(self) -> str:
        names = sorted(str(p.relative_to(self.root)) for p in self.root.rglob("*") if p.is_file())
        if not names:
            return "the folder holds no files"
        more = f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else ""
        return f"it holds {', '.join(names[:_MAX_LISTED])}{more}"


def _top_tables(folder: Path) -> dict[Path, TableFile]:
    """Tables directly in the folder of the recording: declared files, and tables with the header of one."""
    return {**dict(files_in(folder)), **dict(named_tables(folder))}


# Recordings that are folders of images without a table of timestamps, such as from a phone or a manual trigger.
#
# The file name gives the time of an image: a stamp since 1970 in s, ms, us or ns, or else the last number in the name.
# Images with the same stamp or number were taken at the same time.

CLOUD_FILES = "point clouds"  # `TopicInfo.type` of files of point clouds
APART_NS = 1_000_000_000  # artificial stamps: interval from one number to the next
MOST = 9_000_000_000  # largest number: its artificial stamp fits in int64
MIXED = 0.75  # distinct numbers / images; below it, a folder mixes images of several cameras
_SIDES = {"0": "left", "1": "right"}  # last character of a sensor name -> word in file names


def has_pictures(root: Path) -> bool:
    """True if `root` or a direct subfolder contains images, or point clouds and no tables beside them."""
    return bool(_topics(root) or (_topics(root, CLOUD_SUFFIXES) and not _top_tables(root)))


@final
class PictureFolder(Recording):
    """A folder of images, or with one subfolder of images for each camera; and of point clouds of LiDARs at rest.

    A topic of images is the name of a subfolder, `.` for the root, or a file pattern such as `images/*_0.jpg`. The star
    stands for the number of the image. If several images of a folder share a number, such as left1.png and right1.png,
    each pattern is a topic. Topics of clouds are patterns. Files with the same number belong to the same stop.
    """

    def __init__(self, root: Path, window: Window = WHOLE_RECORDING) -> None:
        super().__init__(root, window)
        if not window.is_all:
            self.note(window.note(str(root)))

    def topics(self) -> tuple[TopicInfo, ...]:
        clouds = (replace(self._info(n), type=CLOUD_FILES, kind="points") for n in _topics(self.root, CLOUD_SUFFIXES))
        return (*(self._info(name) for name in _topics(self.root)), *clouds)

    def stamps(self, topic: str) -> np.ndarray:
        return np.array([stamp for stamp, _ in self.stills(topic)], np.int64)

    def image_topic(self, sensor: str, given: str | None) -> str:
        if given is not None and "*" in given:
            return given
        topics = self.topics()
        patterns = [t.name for t in topics if "*" in t.name] if given is None else []
        for word in (sensor, _SIDES.get(sensor[-1:], sensor)):  # such as cam0 for files named left
            named = [name for name in patterns if word in name.lower()]
            if len(named) == 1:
                return named[0]
        return choose_topic(str(self.root), topics, sensor, given, "image").name

    def payloads(self, topic: str) -> Iterator[Payload]:
        files, where = self.stills(topic), f"{self.root}/{topic}"
        return checked_payloads(file_payloads(files, where, self.note), where, self.note)

    def find(self, path: str) -> None:
        """None: the recording has no tables."""

    def table(self, sensor: Sensor, path: str, field: str = "path") -> Path:
        name, (folder, *_) = sensor.name, _topics(self.root)
        if stamped_by_name(pictures_in(self.root / folder)):
            raise RecordingError(
                f"{self.root} holds images, and no data of {name}; add the table {path}, or remove {name} from the rig "
                "file."
            )
        raise RecordingError(
            f"{self.root} holds images without timestamps, and {name} needs them. Remove {name} from the rig file, or "
            "add data.csv with the stamps of the images."
        )

    def _info(self, name: str) -> TopicInfo:
        try:
            stamps = [stamp for stamp, _ in self._files(name)]
        except RecordingError:  # several cameras in a folder: a pattern in the rig file may separate them
            return TopicInfo(name, "pictures", "image", len(pictures_in(self.root / name)), None, None)
        return TopicInfo(name, "pictures", "image", len(stamps), stamps[0], stamps[-1])

    def stills(self, topic: str) -> list[tuple[int, Path]]:
        """Stamp [ns] and file of each image or cloud in the time window, sorted. Adds the files to `files()`."""
        files = self._files(topic)
        if not self.window.is_all:
            stamps_ns = np.array([stamp for stamp, _ in files], np.int64)
            inside = self._inside(stamps_ns, f"{self.root}/{topic}")
            files = [file for file, used in zip(files, inside.tolist(), strict=True) if used]
        for _, path in files:
            self._remember(path)
        return files

    def _files(self, topic: str) -> list[tuple[int, Path]]:
        """Stamp [ns] and file of each image, sorted. Raises RecordingError if a number is missing or repeated."""
        if "*" in topic:
            before, _, after = topic.partition("*")
            paths = [p for p in self.root.glob(topic) if p.suffix.lower() in (*SUFFIXES, *CLOUD_SUFFIXES)]
            keys = [str(p.relative_to(self.root))[len(before) : -len(after) or None] for p in paths]
        else:
            paths = pictures_in(self.root / topic)
            keys = [p.stem for p in paths]
        if not paths:
            raise RecordingError(f"{self.root} has no images {topic}; correct `topic` of the camera in the rig file.")
        images = stamped_by_name(paths, keys, self.note)
        what = "number" if images is None else "stamp"
        if images is None and not self.window.is_all:
            raise RecordingError(
                f"{self.root} holds images without timestamps, so --from and --to cannot be used; leave them out."
            )
        images = images or self._numbered(dict(zip(paths, keys, strict=True)))
        for (a, first), (b, second) in zip(images, images[1:], strict=False):
            if a == b:
                raise RecordingError(
                    f"{first} and {second.name} have the same {what}, {a}; give each image of a camera its own."
                )
        return [(at * (APART_NS if what == "number" else 1), path) for at, path in images]

    def _numbered(self, keys: dict[Path, str]) -> list[tuple[int, Path]]:
        """Number and file of each image, sorted. Raises RecordingError if most of the names `keys` have none."""
        numbers = {path: digits for path, key in keys.items() if (digits := re.findall(r"\d+", key))}
        images = sorted((n, path) for path, digits in numbers.items() if (n := int(digits[-1])) <= MOST)
        named = [path for _, path in images]
        if not are_most(named, list(keys), self.note):
            unnamed = next(path for path in keys if path not in named)
            raise RecordingError(
                f"the name of {unnamed} has neither a number nor a stamp since 1970; name images 0001.jpg, 0002.jpg, "
                "..., with the same number for those taken together."
            )
        return images


def _topics(root: Path, suffixes: Sequence[str] = SUFFIXES) -> list[str]:
    folders = sorted(p.name for p in root.iterdir() if pictures_in(p, suffixes)) if root.is_dir() else []
    patterns = _image_patterns if suffixes is SUFFIXES else _cloud_patterns
    return [name for folder in (".", *folders) for name in patterns(root, folder)]


def _image_patterns(root: Path, folder: str) -> list[str]:
    """Topics of `folder`: file patterns, if it mixes the images of several cameras with shared numbers; else `folder`;
    empty without images."""
    pictures = pictures_in(root / folder)
    return _patterns_of_sensors(folder, pictures) or ([folder] if pictures else [])


def _cloud_patterns(root: Path, folder: str) -> list[str]:
    """Topics of `folder`, as `_image_patterns`; a single LiDAR has a pattern, too, as images may be beside it."""
    clouds = pictures_in(root / folder, CLOUD_SUFFIXES)
    of_one = [pattern if folder == "." else f"{folder}/{pattern}" for pattern in {f"*{p.suffix}": 0 for p in clouds}]
    return _patterns_of_sensors(folder, clouds) or of_one


def _patterns_of_sensors(folder: str, files: list[Path]) -> list[str]:
    """File patterns, if `files` of `folder` are those of several sensors with shared numbers; else empty."""
    paths = [path for path in files if re.search(r"\d", path.stem)]
    # The number is the last or the second last in the names, whichever gives fewer patterns.
    patterns = min((_patterns(paths, place) for place in (-1, -2)), key=len)
    numbers = [number for group in patterns.values() for number in group]
    # With two sensors nearly all numbers occur twice. Different names of one sensor hardly share numbers.
    alike = len(patterns) > 1 and min(map(len, patterns.values())) > 1
    if alike and sum(map(len, patterns.values())) == len(paths) and len(set(numbers)) < MIXED * len(numbers):
        return sorted(pattern if folder == "." else f"{folder}/{pattern}" for pattern in patterns)
    return []


def _patterns(paths: list[Path], place: int) -> dict[str, set[int]]:
    """Image numbers by file pattern, in which a star replaces the number. place: index of the number in the name, -1
    for the last."""
    patterns: dict[str, set[int]] = {}
    for path in paths:
        digits = [*re.finditer(r"\d+", path.stem)]
        if len(digits) >= -place:
            a, b = digits[place].span()
            patterns.setdefault(f"{path.stem[:a]}*{path.stem[b:]}{path.suffix}", set()).add(int(path.stem[a:b]))
        else:
            patterns.setdefault(path.name, set()).add(0)
    return patterns


# Folders that are being written.

_HEADER = re.compile(rb"(?:[^\n]*[^\n\d.,;eE+\s-][^\n]*\n)?")  # the first line, if it has more than numbers
_SETTLED_S = 0.3  # after which an image file counts as complete


@dataclass
class FilePart(NewPart):
    """Rows of tables and images of a folder. tables: header and rows by path in the folder; images: files by path."""

    tables: dict[str, tuple[bytes, bytes]]
    images: dict[str, Path]

    def recording(self, folder: Path) -> FolderRecording:
        for name, (header, rows) in self.tables.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(header + rows)
        for name, file in self.images.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).symlink_to(file.absolute())
        return FolderRecording(folder)

    def without(self, topics: Set[str]) -> FilePart:
        return FilePart({name: table for name, table in self.tables.items() if name not in topics}, {})

    def joined(self, others: Sequence[FilePart]) -> FilePart:
        tables: dict[str, tuple[bytes, list[bytes]]] = {}
        for name, (header, rows) in (item for part in (self, *others) for item in part.tables.items()):
            tables.setdefault(name, (header, []))[1].append(rows)
        return FilePart({name: (header, b"".join(rows)) for name, (header, rows) in tables.items()}, {})


class GrowingFolder:
    """A folder to which images, named by stamps in ns, and rows of tables are added."""

    def __init__(self, root: Path) -> None:
        self.unread: dict[Path, str] = {}
        self._root = root
        self._tables: dict[str, tuple[bytes, int]] = {}  # header, and number of bytes that were read
        self._newest: dict[Path, int] = {}  # stamp of the newest image that was read, by folder

    def part(self) -> FilePart | None:
        """See `Growing`."""
        images, tables = self._new_images(), {}
        filmed = {folder.parent for folder in self._newest}
        for path in sorted(p for pattern in ("*.csv*", "*/*.csv*", "mav0/*/*.csv*") for p in self._root.glob(pattern)):
            if path.name in _OF_IMAGES and path.parent in filmed:
                continue
            if path.suffix == ".gz":
                self.unread[path] = f"{path} is compressed and cannot be followed; let it be written as {path.stem}."
            elif path.suffix == ".csv" and (rows := self._new_rows(path)):
                name = str(path.relative_to(self._root))
                tables[name] = self._tables[name][0], rows
        return FilePart(tables, images) if tables or images else None

    def _new_rows(self, path: Path) -> bytes:
        """Complete rows of a table since the last look."""
        name = str(path.relative_to(self._root))
        header, done = self._tables.get(name, (b"", 0))
        with path.open("rb") as file:
            file.seek(done)
            rows = file.read(PART_BYTES)
        rows = rows[: rows.rfind(b"\n") + 1]
        if not done and (first := _HEADER.match(rows)):
            header = first[0]
        self._tables[name] = header, done + len(rows)
        return rows if done else rows[len(header) :]

    def _new_images(self) -> dict[str, Path]:
        """Images since the last look, by path in the folder."""
        images: dict[str, Path] = {}
        for folder in (p for pattern in ("*", "*/data", "mav0/*/data") for p in self._root.glob(pattern) if p.is_dir()):
            pictures = pictures_in(folder)
            named = [(int(p.stem), p) for p in pictures if p.stem.isdecimal()]
            if len(named) < len(pictures):
                self.unread[folder] = f"{folder} has images that cannot be followed; name them by their stamps in ns."
            new = sorted(pair for pair in named if pair[0] > self._newest.get(folder, -1))
            while new and time.time() - new[-1][1].stat().st_mtime < _SETTLED_S:
                new.pop()
            if new:
                self._newest[folder] = new[-1][0]
            images |= {str(p.relative_to(self._root)): p for _, p in new}
        return images
