"""Images and videos of recordings: reading, checks, decoding."""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain, islice
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from icalib.base.extras import load_cv2
from icalib.base.files import HEAD_BYTES, VIDEO_FILE, hash_of, is_video, most_bytes, not_data, regular
from icalib.base.remark import Remark
from icalib.data.messages import TopicInfo
from icalib.data.stamps import is_rate, nanoseconds, unit_by_date, unit_of_stamps
from icalib.errors import RecordingError
from icalib.rig import TimeUnit
from icalib.sensors.stream import which_image

# Recorded images and their decoding to greyscale, a pure function that can run in other processes.

NO_PICTURE = "unknown"  # encoding of a file that is no image
FILE_FORMATS = ("jpeg", "png", "bmp", "tiff", "pnm", "webp")  # of image files, decoded by OpenCV
DARKEST, BRIGHTEST = 0.1, 99.9  # percentiles of images above 8 bits that map to 0 and 255; excludes hot, dead pixels
PERCENTILE_PIXELS = 100_000  # number of pixels, of an image, from which percentiles are computed
Convert = Callable[[np.ndarray, Any], np.ndarray]


class DamagedImageError(RecordingError):
    """One image cannot be decoded; other images of the stream may be valid."""


@dataclass(frozen=True)
class DecodedImage:
    """A decoded image: stamp_ns on the clock of the camera, image (height, width) uint8, greyscale."""

    stamp_ns: int
    image: np.ndarray


@dataclass(frozen=True)
class Payload:
    """One image as recorded, not decoded; it can be sent to another process.

    source: name of the stream for messages. encoding: of sensor_msgs/Image, or one of `FILE_FORMATS`; for files with a
    Bayer mosaic also the pixel encoding, after a blank. width, height [px]: 0 if the file header does not tell. step:
    bytes per row, 0 for files. name: of the file, empty for images in bags.
    """

    stamp_ns: int
    source: str
    encoding: str
    data: bytes
    width: int
    height: int
    step: int = 0
    big_endian: bool = False
    name: str = ""

    @property
    def which(self) -> str:
        """Identifies the image in messages, by file name or stamp."""
        return which_image(self.name, self.stamp_ns)


def decode(payload: Payload) -> np.ndarray:
    """The greyscale image, (height, width) uint8. Images above 8 bits are scaled so that 0.1 % of pixels saturate at
    each end.

    Raises RecordingError for an unknown encoding, DamagedImageError for short or damaged data.
    """
    if is_file(payload.encoding):
        return _decode_file(payload)
    if payload.encoding not in _ENCODINGS:
        raise RecordingError(unknown_encoding(payload))
    pixel_bytes, convert = _ENCODINGS[payload.encoding]
    rows = _rows(payload, pixel_bytes)
    return np.require(convert(rows, payload), requirements=("C", "W"))


def is_known(encoding: str) -> bool:
    """True if `decode` supports the encoding."""
    return encoding in _ENCODINGS or is_file(encoding)


def is_file(encoding: str) -> bool:
    """True for the encoding of an image file, such as jpeg; False for raw pixels."""
    return encoding.split(" ")[0] in FILE_FORMATS


def unknown_encoding(payload: Payload) -> str:
    """Error message for an encoding that `decode` does not support."""
    known = ", ".join(sorted(_ENCODINGS))
    return (
        f"{payload.source}: the image {payload.which} has the encoding {payload.encoding!r}, which icalib "
        f"does not read; record jpeg, png, or one of {known}."
    )


def file_payload(stamp_ns: int, source: str, data: bytes, described: str = "") -> Payload:
    """The payload of an image file. Its format is detected from the content, or else taken from `described`, the text
    of the recorder (CompressedImage.format)."""
    words = described.replace(";", " ").lower().split()
    encoding = _file_format(data, words)
    if encoding in FILE_FORMATS and words and words[-1] in _BAYER:
        encoding = f"{encoding} {words[-1]}"
    width, height = file_size(data)
    if encoding in ("tiff", "pnm", "webp"):  # rare formats: decoded, as there is no parser of their headers
        image = _decoded(data)
        height, width = (0, 0) if image is None else image.shape[:2]
    return Payload(stamp_ns, source, encoding, data, width, height)


def file_size(data: bytes) -> tuple[int, int]:
    """Width and height [px] in the header of a JPEG, PNG or BMP file; (0, 0) for other or damaged files."""
    if data.startswith(_PNG) and len(data) >= 24:
        return struct.unpack_from(">II", data, 16)
    if data.startswith(b"BM") and len(data) >= 26:
        width, height = struct.unpack_from("<ii", data, 18)
        return width, abs(height)
    at = 2 if data.startswith(_JPEG) else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4])
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of frame
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 1 if marker == 0xFF else 2 + length
    return 0, 0


def _png_chunks(data: bytes) -> Iterator[int]:
    """Stated sizes [bytes] of the chunks of a PNG; none for other files."""
    at = len(_PNG) if data.startswith(_PNG) else len(data)
    while at < len(data):
        yield (size := int.from_bytes(data[at : at + 4]))
        at += 12 + size  # with its size, name and checksum


_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"


def _file_format(data: bytes, words: list[str]) -> str:
    if data.startswith(_JPEG):
        return "jpeg"
    if data.startswith(_PNG):
        return "png"
    if data.startswith((b"II*\0", b"MM\0*")):
        return "tiff"
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return "webp"
    if data.startswith(b"BM") and int.from_bytes(data[2:6], "little") == len(data):
        return "bmp"
    if re.match(rb"P[1-6]\s", data):
        return "pnm"
    for name in ("jpeg", "png"):
        if name in words or (name == "jpeg" and "jpg" in words):
            return name
    return " ".join(words) or NO_PICTURE


def _decode_file(payload: Payload) -> np.ndarray:
    image = _decoded(payload.data)
    if image is None:
        raise DamagedImageError(f"{payload.source}: the image {payload.which} is damaged; leave it out.")
    image = _to_8_bits(image)
    mosaic = payload.encoding.partition(" ")[2]
    return _demosaic(mosaic)(image, payload) if mosaic else image


def _decoded(data: bytes) -> np.ndarray | None:
    """Greyscale image with the bit depth of the file; None if it is damaged, or has too many pixels for its bytes
    (`most_bytes`). OpenCV allocates what the header and the chunks of a PNG state."""
    if prod(file_size(data)) > most_bytes(len(data)) or any(n > len(data) for n in _png_chunks(data)):
        return None
    cv2 = load_cv2()
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None


def _rows(payload: Payload, pixel_bytes: int) -> np.ndarray:
    """(height, width * pixel_bytes) uint8: image rows without padding. Raises DamagedImageError for too few bytes."""
    wanted = payload.width * pixel_bytes
    step = payload.step or wanted
    if step < wanted or len(payload.data) < step * payload.height or not wanted * payload.height:
        raise DamagedImageError(
            f"{payload.source}: the image {payload.which} has {len(payload.data)} bytes, too few for "
            f"{payload.width} x {payload.height} px of {payload.encoding} in rows of {step} bytes; leave it out."
        )
    rows = np.frombuffer(payload.data, np.uint8, step * payload.height).reshape(payload.height, step)
    return np.ascontiguousarray(rows[:, :wanted])


def _to_8_bits(image: np.ndarray) -> np.ndarray:
    """Scales by percentiles to 8 bits: cameras with 10 or 12 bits use only part of 16, thermal cameras a few hundred
    levels, and a single hot pixel has the maximum."""
    if image.dtype == np.uint8:
        return image
    few = image.ravel()[:: max(image.size // PERCENTILE_PIXELS, 1)]
    finite = few[np.isfinite(few)]
    low, high = np.percentile(finite, (DARKEST, BRIGHTEST)) if len(finite) else (0.0, 0.0)
    scale = 255.0 / (high - low) if high > low else 0.0
    return np.clip(np.rint((np.nan_to_num(image.astype(np.float32)) - low) * scale), 0.0, 255.0).astype(np.uint8)


def _sixteen_bits(rows: np.ndarray, payload: Payload) -> np.ndarray:
    return _to_8_bits(rows.view(">u2" if payload.big_endian else "<u2"))


def _colour(code: str, channels: int) -> Convert:
    def convert(rows: np.ndarray, payload: Payload) -> np.ndarray:
        cv2 = load_cv2()
        return cv2.cvtColor(rows.reshape(payload.height, payload.width, channels), getattr(cv2, f"COLOR_{code}2GRAY"))

    return convert


def _demosaic(encoding: str) -> Convert:
    def convert(rows: np.ndarray, _: Payload) -> np.ndarray:
        cv2 = load_cv2()
        return cv2.cvtColor(rows, getattr(cv2, f"COLOR_Bayer{_BAYER[encoding]}2GRAY"))

    return convert


def _luma(first: int) -> Convert:
    return lambda rows, _: rows[:, first::2]


# Names of Bayer mosaics: ROS uses the first two rows, OpenCV the pixels (1, 1) and (1, 2).
_BAYER = {"bayer_rggb8": "BG", "bayer_bggr8": "RG", "bayer_gbrg8": "GR", "bayer_grbg8": "GB"}
_ENCODINGS: dict[str, tuple[int, Convert]] = {  # bytes per pixel, conversion of rows to greyscale
    **{name: (1, lambda rows, _: rows) for name in ("mono8", "8UC1")},
    **{name: (2, _sixteen_bits) for name in ("mono16", "16UC1")},
    **{name: (3, _colour("BGR", 3)) for name in ("bgr8", "8UC3")},
    "rgb8": (3, _colour("RGB", 3)),
    "bgra8": (4, _colour("BGRA", 4)),
    "rgba8": (4, _colour("RGBA", 4)),
    **{name: (1, _demosaic(name)) for name in _BAYER},
    **{name: (2, _luma(1)) for name in ("yuv422", "uyvy")},
    **{name: (2, _luma(0)) for name in ("yuv422_yuy2", "yuyv")},
}


# Checks of image streams: one camera, ordered stamps, no frozen images. Rejected images are counted in notes.

Note = Callable[[Remark], None]
LOOK_AHEAD = 5  # number of first images; their most frequent resolution is that of the camera
ODD, ODD_SHARE = 2, 0.1  # tolerated images of another resolution, as number or share; more: several cameras
_LATE_NS = 1_000_000_000  # an image late by more means that the clock was set back


def ignore(sentence: Remark) -> None:
    """A `Note` that discards the sentence."""


def checked_payloads(payloads: Iterable[Payload], where: str, note: Note) -> Iterator[Payload]:
    """Images of `payloads` with strictly increasing stamps and one resolution; a note on rejected images at the end.

    Rejected are files that are no images, images of zeros, exact repetitions of the previous image (frozen camera),
    late images, and a few of another resolution. Raises RecordingError, naming `where` and the image, for an unknown
    encoding, many images of another resolution, a clock that was set back, or no usable image.
    """
    dropped = _Dropped()
    kept, odd = 0, 0
    last: Payload | None = None
    size, ahead = _usual_size(payloads)
    for payload in ahead:
        if (fault := _content_fault(payload)) is not None:
            dropped.add(fault[0], payload, fault[1])
            continue
        if size and payload.width and (payload.width, payload.height) != size:
            odd += 1
            error = _other_size(payload, size, where)
            if odd > max(ODD, ODD_SHARE * kept):
                raise RecordingError(error)
            dropped.add(
                Remark("images_of_other_size", f"have another size than {size[0]} x {size[1]} px"), payload, error
            )
            continue
        if last is not None and (reason := _does_not_follow(last, payload, where)):
            dropped.add(reason, payload)
            continue
        last = payload
        kept += 1
        yield payload
    if not kept and dropped.first_error:
        raise RecordingError(dropped.first_error)
    _refuse_too_few(kept, dropped, where)
    dropped.note(where, note)


def _content_fault(payload: Payload) -> tuple[Remark, str] | None:
    """Reason to reject a payload without image content, and the error message in case no image remains; None for an
    image. Raises RecordingError for an unknown encoding."""
    if not np.frombuffer(payload.data, np.uint8).any():
        return Remark("images_of_zeros", "consist of zeros"), ""
    if payload.encoding == NO_PICTURE:
        return Remark("messages_without_image", "are not images"), unknown_encoding(payload)
    if not is_known(payload.encoding):
        raise RecordingError(unknown_encoding(payload))
    return None


def _does_not_follow(last: Payload, payload: Payload, where: str) -> Remark | None:
    """Reason to reject an image that follows the image `last`; None if there is none. Raises RecordingError if the
    clock was set back."""
    _refuse_other_clock(last, payload, where)
    if payload.stamp_ns <= last.stamp_ns:
        return Remark("images_out_of_order", "are not later than their predecessor")
    if payload.data != last.data:
        return None
    return Remark("camera_frozen", "repeat their predecessor exactly (the camera froze)")


def frames(payloads: Iterable[Payload], where: str, note: Note) -> Iterator[DecodedImage]:
    """The decoded images. Damaged ones are rejected, with a note at the end.

    Raises RecordingError if all are damaged.
    """
    dropped = _Dropped()
    kept = 0
    for payload in payloads:
        try:
            image = decode(payload)
        except DamagedImageError as error:
            dropped.add(Remark("frames_damaged", "are damaged"), payload, str(error))
            continue
        kept += 1
        yield DecodedImage(payload.stamp_ns, image)
    if not kept and dropped.first_error:
        raise RecordingError(dropped.first_error)
    dropped.note(where, note)


class _Dropped:
    """Rejected images by reason: their number, the first image, and the first error message."""

    def __init__(self) -> None:
        self.count: dict[Remark, int] = {}
        self._first: dict[str, str] = {}
        self.first_error = ""

    def add(self, reason: Remark, payload: Payload, error: str = "") -> None:
        self.count[reason] = self.count.get(reason, 0) + 1
        self._first.setdefault(reason, payload.which)
        self.first_error = self.first_error or error

    def note(self, where: str, note: Note) -> None:
        for reason, count in self.count.items():
            sentence = f"{where}: {count} images that {reason} were left out, the first {self._first[reason]}."
            note(reason.with_sentence(sentence))


def _usual_size(payloads: Iterable[Payload]) -> tuple[tuple[int, int], Iterator[Payload]]:
    """Most frequent width and height [px] of the first images, (0, 0) if unknown; and an iterator of all payloads."""
    rest = iter(payloads)
    first = list(islice(rest, LOOK_AHEAD))
    sizes = Counter((p.width, p.height) for p in first if p.width)
    return sizes.most_common(1)[0][0] if sizes else (0, 0), chain(first, rest)


def _other_size(payload: Payload, size: tuple[int, int], where: str) -> str:
    return (
        f"{where}: the image {payload.which} has {payload.width} x {payload.height} px, others have "
        f"{size[0]} x {size[1]} px; record each resolution under its own name."
    )


def _refuse_other_clock(last: Payload, payload: Payload, where: str) -> None:
    if payload.stamp_ns < last.stamp_ns - _LATE_NS:
        raise RecordingError(
            f"{where}: the image {payload.which} comes after the one {last.which}, so the camera's clock was "
            "set back; record again, or cut the recording there with --from and --to."
        )


def _refuse_too_few(kept: int, dropped: _Dropped, where: str) -> None:
    total = kept + sum(dropped.count.values())
    if not total:
        raise RecordingError(f"{where}: there are no images; check that the camera was running.")
    if kept > 1 or not dropped.count:
        return
    reasons = ", ".join(f"{count} {reason}" for reason, count in dropped.count.items())
    raise RecordingError(f"{where}: of {total} images, {reasons}; check the camera and record again.")


# Image folders in the format of EuRoC (`cam0/data/*.png`, and `cam0/data.csv` with t [ns], file name) or of Kalibr's
# bagcreater (`cam0/STAMP.png`).
#
# Video files of one camera. Stamps of frames come from a table beside the video, or from the video itself.

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


def pictures_in(folder: Path, suffixes: Sequence[str] = SUFFIXES) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in suffixes) if folder.is_dir() else []


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
        sentence = (
            f"{odd[0].parent}: {len(odd)} of {len(files)} images were left out, the first {odd[0].name}: its name "
            "has neither a number nor a stamp since 1970, as the others have."
        )
        note(Remark("images_without_number", sentence))
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
        sentence = f"{where}: {len(pointers)} of {len(files)} images cannot be read, the first: {pointers[0]}"
        note(Remark("images_not_downloaded", sentence))
    if missing:
        sentence = (
            f"{where}: {len(missing)} of {len(files)} images are missing or empty, the first is {missing[0].name}."
        )
        note(Remark("images_missing", sentence))


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
    sentence = f"{names}: {same} images were found under the same name with another ending."
    note(Remark("images_with_other_endings", sentence))
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
