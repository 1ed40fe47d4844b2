"""Recorded images and their decoding to greyscale, a pure function that can run in other processes."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from icalib.base.extras import load_cv2
from icalib.base.input_files import most_bytes
from icalib.errors import RecordingError
from icalib.sensors.stream import which_image

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
