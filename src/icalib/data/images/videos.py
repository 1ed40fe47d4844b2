"""Video files of one camera. Stamps of frames come from a table beside the video, or from the video itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from icalib.base.extras import load_cv2
from icalib.data.images.euroc_images import unit_of_texts
from icalib.data.images.images import Payload
from icalib.data.images.unreadable import VIDEO_FILE, is_video
from icalib.data.stamps.clocks import nanoseconds
from icalib.data.topics import TopicInfo
from icalib.errors import RecordingError

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
    lines = table.read_bytes().count(b"\n")
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
