"""Recordings that are folders of images without a table of timestamps, such as from a phone or a manual trigger.

The file name gives the time of an image: a stamp since 1970 in s, ms, us or ns, or else the last number in the name.
Images with the same stamp or number were taken at the same time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import final

import numpy as np

from icalib.data.images.image_checks import checked_payloads
from icalib.data.images.image_files import SUFFIXES, are_most, file_payloads, pictures_in, stamped_by_name
from icalib.data.images.images import Payload
from icalib.data.recordings.base import Recording
from icalib.data.stamps.window import WHOLE_RECORDING, Window
from icalib.data.topics import TopicInfo, choose_topic
from icalib.errors import RecordingError
from icalib.sensors.sensor import Sensor

APART_NS = 1_000_000_000  # artificial stamps: interval from one number to the next
MOST = 9_000_000_000  # largest number: its artificial stamp fits in int64
MIXED = 0.75  # distinct numbers / images; below it, a folder mixes images of several cameras
_SIDES = {"0": "left", "1": "right"}  # last character of a sensor name -> word in file names


def has_pictures(root: Path) -> bool:
    """True if `root` or a direct subfolder contains images."""
    return bool(_topics(root))


@final
class PictureFolder(Recording):
    """A folder of images, or with one subfolder of images for each camera.

    A topic is the name of a subfolder, `.` for the root, or a file pattern such as `images/*_0.jpg`. The star stands
    for the number of the image. If several images of a folder share a number, such as left1.png and right1.png,
    each pattern is a topic.
    """

    def __init__(self, root: Path, window: Window = WHOLE_RECORDING) -> None:
        super().__init__(root, window)
        if not window.is_all:
            self.note(window.note(str(root)))

    def topics(self) -> tuple[TopicInfo, ...]:
        return tuple(self._info(name) for name in _topics(self.root))

    def stamps(self, topic: str) -> np.ndarray:
        return np.array([stamp for stamp, _ in self._files_inside(topic)], np.int64)

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
        files, where = self._files_inside(topic), f"{self.root}/{topic}"
        for _, path in files:
            self._remember(path)
        return checked_payloads(file_payloads(files, where, self.note), where, self.note)

    def find(self, path: str) -> None:
        """None: the recording has no tables."""

    def table(self, sensor: Sensor, path: str, field: str = "path") -> Path:
        del field
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

    def _files_inside(self, topic: str) -> list[tuple[int, Path]]:
        """As `_files`, for images in the time window."""
        files = self._files(topic)
        if self.window.is_all:
            return files
        stamps_ns = np.array([stamp for stamp, _ in files], np.int64)
        inside = self._inside(stamps_ns, f"{self.root}/{topic}")
        return [file for file, used in zip(files, inside.tolist(), strict=True) if used]

    def _files(self, topic: str) -> list[tuple[int, Path]]:
        """Stamp [ns] and file of each image, sorted. Raises RecordingError if a number is missing or repeated."""
        if "*" in topic:
            before, _, after = topic.partition("*")
            paths = [p for p in self.root.glob(topic) if p.suffix.lower() in SUFFIXES]
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


def _topics(root: Path) -> list[str]:
    folders = sorted(p.name for p in root.iterdir() if p.is_dir() and pictures_in(p)) if root.is_dir() else []
    return [name for folder in (".", *folders) for name in _patterns_of_cameras(root, folder)]


def _patterns_of_cameras(root: Path, folder: str) -> list[str]:
    """Topics of `folder`: file patterns, if it mixes the images of several cameras with shared numbers; else `folder`;
    empty without images."""
    pictures = pictures_in(root / folder)
    paths = [path for path in pictures if re.search(r"\d", path.stem)]
    # The number is the last or the second last in the names, whichever gives fewer patterns.
    patterns = min((_patterns(paths, place) for place in (-1, -2)), key=len)
    numbers = [number for group in patterns.values() for number in group]
    # With two cameras nearly all numbers occur twice. Different names of one camera hardly share numbers.
    alike = len(patterns) > 1 and min(map(len, patterns.values())) > 1
    if alike and sum(map(len, patterns.values())) == len(paths) and len(set(numbers)) < MIXED * len(numbers):
        return sorted(pattern if folder == "." else f"{folder}/{pattern}" for pattern in patterns)
    return [folder] if pictures else []


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
