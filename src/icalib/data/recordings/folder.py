"""Recordings that are folders: tables such as `imu0/data.csv` and `cam0/corners.csv` (also gzip), images, videos."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import astuple
from functools import cached_property
from pathlib import Path
from typing import final

import numpy as np

from icalib.base.input_files import VIDEO_FILE
from icalib.data.images.image_checks import Note, checked_payloads, ignore
from icalib.data.images.image_files import (
    file_payloads,
    image_files,
    stamp_table,
    video_payloads,
    video_stamps,
    video_topic,
    videos_in,
)
from icalib.data.images.images import Payload
from icalib.data.recordings.base import Recording
from icalib.data.stamps.window import WHOLE_RECORDING, Window
from icalib.data.tables.numbered import numbered_pictures, stamped_by_rows
from icalib.data.tables.table import StampsOfRows, TableFile, files_in, named_tables, rows_of
from icalib.data.topics import TopicInfo, choose_topic, find_topic, type_not_read
from icalib.errors import RecordingError
from icalib.rig import PLAIN_TABLE, TableLayout
from icalib.sensors.sensor import Sensor

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
                self.note(f"{video}: its frames have the stamps of {table.name}, a table with as many rows.")
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
