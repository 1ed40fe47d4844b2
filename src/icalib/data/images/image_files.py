"""Image folders in the format of EuRoC (`cam0/data/*.png`, and `cam0/data.csv` with t [ns], file name) or of Kalibr's
bagcreater (`cam0/STAMP.png`).

Video files of one camera. Stamps of frames come from a table beside the video, or from the video itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from icalib.base.extras import load_cv2
from icalib.base.input_files import HEAD_BYTES, VIDEO_FILE, hash_of, is_video, not_data, regular
from icalib.data.images.image_checks import Note, ignore
from icalib.data.images.images import Payload, file_payload
from icalib.data.stamps.clocks import is_rate, nanoseconds, unit_by_date, unit_of_stamps
from icalib.data.topics import TopicInfo
from icalib.errors import RecordingError
from icalib.rig import TimeUnit

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
_RATE_HZ = (1e-3, 1000.0)
_STAMPED = re.compile(r"[^0-9]*?(?P<stamp>[0-9]{9,19}(\.[0-9]+)?)")  # a word such as left_ may precede it


def image_files(folder: Path, note: Note = ignore) -> list[tuple[int, Path]]:
    """Stamps [ns] and files of the images of a camera folder, in the order of data.csv; without one, sorted by stamp.

    The images are in the subfolder `data`, or in `folder` itself if their names are dates. Empty without images. note:
    called if files have another suffix than data.csv says, and on a few names that are none of it. Raises
    RecordingError naming an unreadable line.
    """
    data = folder / "data"
    paths = pictures_in(data)
    if not paths:
        return stamped_by_name(pictures_in(folder), (), note) or []
    table = folder / "data.csv"
    if table.is_file():
        return _with_other_endings(_listed(table, data), paths, table, note)
    if named := stamped_by_name(paths, (), note):
        return named
    numbered = [p for p in paths if p.stem.isdecimal() and int(p.stem) < 2**63]
    if not are_most(numbered, paths, note):
        unnamed = next(p for p in paths if p not in numbered)
        raise RecordingError(
            f"{folder} has no data.csv, and the name of {unnamed.name} is not a stamp in ns; write data.csv with "
            "lines t [ns],file name."
        )
    return sorted((int(p.stem), p) for p in numbered)


def pictures_in(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES) if folder.is_dir() else []


def stamped_by_name(
    files: Sequence[Path], names: Sequence[str] = (), note: Note = ignore
) -> list[tuple[int, Path]] | None:
    """Stamps [ns] and files, sorted by stamp, if most names are times since 1970 in the same unit; else None.

    names: the part of each name that contains the stamp; default: the name without suffix. note: see `are_most`.
    """
    matches = [(p, _STAMPED.fullmatch(name)) for p, name in zip(files, names or [p.stem for p in files], strict=True)]
    texts = {p: match["stamp"] for p, match in matches if match}
    unit = unit_by_date([float(text) for text in texts.values()]) if texts else None
    if unit is None or not are_most(list(texts), files, note):
        return None
    return sorted((nanoseconds(text, unit), p) for p, text in texts.items())


def are_most(named: Sequence[Path], files: Sequence[Path], note: Note = ignore) -> bool:
    """Whether more than half of the images `files` are `named`, by number or stamp. The others are then left out, with
    a note."""
    odd = sorted(set(files) - set(named))
    if odd and len(named) > len(odd):
        note(
            f"{odd[0].parent}: {len(odd)} of {len(files)} images were left out, the first {odd[0].name}: its name has "
            "neither a number nor a stamp since 1970, as the others have."
        )
    return len(named) > len(odd)


def file_payloads(files: list[tuple[int, Path]], where: str, note: Note) -> Iterator[Payload]:
    """Undecoded images of `files` (stamp [ns], path). Missing and empty files and Git LFS pointers are rejected, with a
    note at the end.

    Raises RecordingError if no file is left and some are pointers.
    """
    missing: list[Path] = []
    pointers: list[str] = []
    for stamp_ns, path in files:
        data = path.read_bytes() if path.is_file() else b""
        if data:
            hash_of(path).saw(0, data)
        if sentence := not_data(path, data[:HEAD_BYTES]):
            pointers.append(sentence)
        elif data:
            yield replace(file_payload(stamp_ns, where, data), name=path.name)
        else:
            missing.append(path)
    if pointers:
        if len(pointers) + len(missing) == len(files):
            raise RecordingError(pointers[0])
        note(f"{where}: {len(pointers)} of {len(files)} images cannot be read, the first: {pointers[0]}")
    if missing:
        note(f"{where}: {len(missing)} of {len(files)} images are missing or empty, the first is {missing[0].name}.")


def _listed(table: Path, data: Path) -> list[tuple[int, Path]]:
    """Stamps, converted to ns from the detected unit, and files of data.csv. Raises RecordingError naming the line."""
    rows: list[tuple[int, str, str]] = []
    try:
        lines = table.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{table} cannot be read ({error}); copy it again.") from error
    for number, line in enumerate(lines, 1):
        stamp, name = (*(part.strip() for part in re.split(r"[,;\s]", line.strip(), maxsplit=1)), "")[:2]
        if not line.strip() or stamp.startswith("#") or (not rows and stamp[:1].isalpha()):
            continue
        if not re.fullmatch(r"[0-9]+(\.[0-9]*)?", stamp) or not name:
            raise RecordingError(_line_sentence(table, number, line))
        rows.append((number, stamp, name.strip(",; ")))
    if not rows:
        raise RecordingError(f"{table} holds no rows; write one line for each image, t [ns],file name.")
    unit = unit_of_texts([stamp for _, stamp, _ in rows])
    if unit == "ns":
        for number, stamp, _ in rows:
            if not stamp.isdecimal():
                raise RecordingError(_line_sentence(table, number, lines[number - 1]))
    return [(nanoseconds(stamp, unit), data / name) for _, stamp, name in rows]


def unit_of_texts(stamps: Sequence[str]) -> TimeUnit:
    """Detected unit of stamps: that in which they are dates; else ns if integers in ns give an image rate from 1 mHz to
    1 kHz; else the unit that does; ns by default."""
    numbers = np.array([float(stamp) for stamp in stamps])
    if dated := unit_by_date(numbers.tolist()):
        return dated
    if all(stamp.isdecimal() for stamp in stamps) and is_rate(numbers, *_RATE_HZ):
        return "ns"
    return (unit_of_stamps(numbers, *_RATE_HZ) if len(numbers) > 1 else None) or "ns"


def _line_sentence(table: Path, number: int, line: str) -> str:
    return f"{table}:{number}: {line.strip()[:60]!r} is not t [ns],file name; correct the line."


def _with_other_endings(
    listed: list[tuple[int, Path]], paths: Sequence[Path], table: Path, note: Note
) -> list[tuple[int, Path]]:
    """`listed`, with file names corrected if all suffixes in the table differ from those of the files `paths`."""
    if any(path.is_file() for _, path in listed):
        return listed
    by_stem = {p.stem: p for p in paths}
    renamed = [(stamp, by_stem.get(path.stem, path)) for stamp, path in listed]
    same = sum(path.stem in by_stem for _, path in listed)
    names = f"{table} names {listed[0][1].name}, and {table.parent / 'data'} holds {paths[0].name}"
    if not same:
        raise RecordingError(
            f"{names}: none of its {len(listed)} images is there; correct the names, or copy the images."
        )
    note(f"{names}: {same} images were found under the same name with another ending.")
    return renamed


_TABLES = (".csv", ".txt")
_STAMP = re.compile(r"[0-9]+(\.[0-9]*)?")
_MAX_HEADER_LINES = 20  # of a table of stamps
_TIME = re.compile(r"time|stamp|^t$|^t[_ ]?\[?(ns|us|ms|s)\]?$", re.IGNORECASE)


def videos_in(folder: Path) -> list[Path]:
    """Video files in `folder` and its direct subfolders, sorted by name."""
    return sorted(p for pattern in ("*", "*/*") for p in folder.glob(pattern) if is_video(p) and p.is_file())


def video_topic(path: Path, name: str) -> TopicInfo:
    """Topic of a video, without decoding it. The number of frames is that of the container, and may be off by a few.

    For an unreadable video or table it is 1, so that later reading raises the error.
    """
    try:
        if (times := frame_times(path)) is not None:
            return TopicInfo(name, VIDEO_FILE, "image", len(times), int(times[0]), int(times[-1]))
        with _opened(path) as video:
            count, rate = (float(video.get(what)) for what in (_property("FRAME_COUNT"), _property("FPS")))
    except RecordingError:
        return TopicInfo(name, VIDEO_FILE, "image", 1, None, None)
    frames = max(int(count), 1) if np.isfinite(count) else 1
    return TopicInfo(name, VIDEO_FILE, "image", frames, 0, int(1e9 * (frames - 1) / rate) if rate > 0.0 else None)


def frame_times(path: Path) -> np.ndarray | None:
    """(N,) int64 ns: stamps of frames from the `stamp_table` of the video; None without one. The column is the one
    whose header is a time or stamp, or else the first. Raises RecordingError naming the line."""
    table = stamp_table(path)
    return None if table is None else _stamps_in(table, path.name)


def stamp_table(path: Path) -> Path | None:
    """The table beside the video with the stamps of its frames: `cam0.csv` or `cam0.txt` of `cam0.mp4`, or else the
    only table with as many increasing stamps as the video has frames; None without one. Raises RecordingError if there
    are several."""
    if named := [p for ending in _TABLES if (p := path.with_suffix(ending)).is_file()]:
        return named[0]
    others = {p.stem for p in videos_in(path.parent)}
    tables = sorted(p for ending in _TABLES for p in path.parent.glob(f"*{ending}") if p.stem not in others)
    if not tables:
        return None
    with _opened(path) as video:
        frames = int(video.get(_property("FRAME_COUNT")))
    fitting = [table for table in tables if _has_stamps(table, path.name, frames)]
    if len(fitting) > 1:
        raise RecordingError(
            f"{path}: {' and '.join(p.name for p in fitting)} both have a stamp for each of its {frames} frames; "
            f"rename the right one to {path.stem}{fitting[0].suffix}."
        )
    return fitting[0] if fitting else None


def _has_stamps(table: Path, video: str, count: int) -> bool:
    """Whether the table has `count` increasing stamps."""
    lines = regular(table).read_bytes().count(b"\n")
    if not 0 <= lines + 1 - count <= _MAX_HEADER_LINES:
        return False
    try:
        stamps_ns = _stamps_in(table, video)
    except RecordingError:
        return False
    return len(stamps_ns) == count and bool((np.diff(stamps_ns) > 0).all())


def _stamps_in(table: Path, video: str) -> np.ndarray:
    """(N,) int64 ns: stamps in the table of the file name `video`, see `frame_times`."""
    texts, column = [], 0
    for number, line in enumerate(table.read_text(encoding="utf-8-sig", errors="replace").splitlines(), 1):
        cells = [cell.strip() for cell in re.split(r"[,;\t]\s*|\s+", line.strip().lstrip("#"))]
        if not texts and not _STAMP.fullmatch(cells[min(column, len(cells) - 1)]):
            column = next((k for k, cell in enumerate(cells) if _TIME.search(cell)), column)
            continue
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if len(cells) <= column or not _STAMP.fullmatch(cells[column]):
            raise RecordingError(f"{table}:{number}: {line.strip()[:60]!r} has no stamp; correct the line.")
        texts.append(cells[column])
    if not texts:
        raise RecordingError(f"{table} holds no stamps; write one line for each frame of {video}, or remove it.")
    if len(texts) > 2 and texts in ([str(k + first) for k in range(len(texts))] for first in (0, 1)):
        raise RecordingError(
            f"{table} counts frames and has no stamps; write stamps in its first column, or remove it."
        )
    unit = unit_of_texts(texts)
    return np.array([nanoseconds(text, unit) for text in texts], np.int64)


def video_stamps(path: Path) -> np.ndarray:
    """(N,) int64 ns: stamps of all frames. Raises RecordingError as `video_payloads`."""
    times = frame_times(path)
    return np.array([p.stamp_ns for p in video_payloads(path, str(path))], np.int64) if times is None else times


def video_payloads(path: Path, where: str) -> Iterator[Payload]:
    """The frames in greyscale, one at a time. Without a table of stamps, stamps are those of the video, from 0 on.

    Raises RecordingError if the file cannot be decoded, or if the table has another number of stamps than frames.
    """
    cv2, times, n = load_cv2(), frame_times(path), 0
    with _opened(path) as video:
        while True:
            good, image = video.read()
            video_ns = round(1e6 * float(video.get(_property("POS_MSEC"))))
            if not good or (times is not None and n >= len(times)):
                break
            grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            height, width = grey.shape
            stamp_ns = video_ns if times is None else int(times[n])
            yield Payload(stamp_ns, where, "mono8", grey.tobytes(), width, height, width, name=f"frame {n}")
            n += 1
    if not n:
        raise RecordingError(f"{path} has no frames that can be decoded; copy it again, or convert it to H.264.")
    if times is not None and (good or n != len(times)):
        frames = f"more than {n}" if good else str(n)
        raise RecordingError(
            f"{path} has {frames} frames, and its table {len(times)} stamps; give one for each frame, or remove the "
            "table to use the video's own."
        )


def _property(name: str) -> int:
    return getattr(load_cv2(), f"CAP_PROP_{name}")


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The opened video; frames are not rotated to the orientation in its metadata. Raises RecordingError if it is no
    video."""
    cv2 = load_cv2()
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not video.isOpened():
            raise RecordingError(f"{path} cannot be decoded as a video; copy it again, or convert it to H.264.")
        video.set(_property("ORIENTATION_AUTO"), 0)
        yield video
    finally:
        video.release()
