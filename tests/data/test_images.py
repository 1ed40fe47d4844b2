"""Decoding: every encoding against the obvious formula, row padding, byte order, damage."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from tests.cases import each

from icalib.data.images import file_payload, file_size
from icalib.data.recordings import DamagedImageError, Payload, decode
from icalib.errors import RecordingError

H, W = 6, 10
RNG = np.random.default_rng(7)
GREY = RNG.integers(0, 256, (H, W), dtype=np.uint8)
COLOUR = RNG.integers(0, 256, (H, W, 3), dtype=np.uint8)  # r, g, b
LUMA = COLOUR @ np.array([0.299, 0.587, 0.114])


def raw(encoding: str, pixels: np.ndarray, padding: int = 0, big_endian: bool = False) -> Payload:
    """`pixels` (H, W, ...) with `padding` bytes of rubbish after each row."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    rows = np.hstack([rows, np.full((len(rows), padding), 0xAB, np.uint8)])
    height, width = pixels.shape[:2]
    return Payload(5, "run.bag /cam", encoding, rows.tobytes(), width, height, rows.shape[1], big_endian)


@each("padding", [0, 3])
@each("encoding", ["mono8", "8UC1"])
def test_grey_is_itself(encoding, padding):
    image = decode(raw(encoding, GREY, padding))
    assert image.dtype == np.uint8 and image.flags.c_contiguous and image.flags.writeable
    np.testing.assert_array_equal(image, GREY)


@each("padding", [0, 5])
@each(
    ("encoding", "channels"),
    [("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0]), ("rgba8", [0, 1, 2, 0]), ("bgra8", [2, 1, 0, 0])],
)
def test_colour_is_luma(encoding, channels, padding):
    image = decode(raw(encoding, COLOUR[..., channels], padding))
    np.testing.assert_allclose(image, LUMA, atol=1.0)


@each("big_endian", [False, True])
@each("padding", [0, 4])
@each(("darkest", "brightest"), [(0, 200), (0, 1023), (0, 65535), (29_000, 29_300)])
def test_sixteen_bits_are_stretched(darkest, brightest, padding, big_endian):
    pixels = RNG.integers(darkest, brightest + 1, (H, W)).astype(np.uint16)
    pixels[2, 3], pixels[0, 1] = brightest, darkest
    payload = raw("mono16", pixels.astype(">u2" if big_endian else "<u2"), padding, big_endian)
    expected = 255.0 * (pixels.astype(float) - darkest) / (brightest - darkest)
    np.testing.assert_allclose(decode(payload), expected, atol=3.0)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_single_hot_and_dead_pixels_take_no_grey_levels(dtype):
    ramp = np.tile(np.linspace(30_000.0, 30_400.0, 200), (100, 1)).astype(dtype)
    pixels = ramp.copy()
    pixels[3, 4], pixels[70, 9] = 65_535, 0
    found = decode(file_payload(5, "x", cv2.imencode(".tiff", pixels)[1].tobytes()))
    assert (found[3, 4], found[70, 9]) == (255, 0)
    others = np.ones(pixels.shape, dtype=bool)
    others[[3, 70], [4, 9]] = False
    np.testing.assert_allclose(found[others], 255.0 * (ramp[others] - 30_000.0) / 400.0, atol=2.0)
    assert not decode(file_payload(5, "x", cv2.imencode(".tiff", np.full_like(pixels, 7))[1].tobytes())).any()


@each(("ending", "encoding"), [(".bmp", "bmp"), (".tif", "tiff"), (".pgm", "pnm"), (".ppm", "pnm"), (".webp", "webp")])
def test_other_files(ending, encoding):
    image = COLOUR[..., ::-1] if ending != ".pgm" else LUMA.round().astype(np.uint8)
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if ending == ".webp" else []
    payload = file_payload(5, "x", cv2.imencode(ending, image, options)[1].tobytes())
    assert payload.encoding == encoding
    assert (payload.width, payload.height) == (W, H)
    np.testing.assert_allclose(decode(payload), LUMA, atol=1.5)


@each("order", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaic_of_one_colour_is_its_luma(order):
    """The name of an encoding is its first row and its second: rggb has red at (0, 0), blue at (1, 1)."""
    colour = {"r": 200, "g": 90, "b": 20}
    mosaic = np.empty((H, W), np.uint8)
    for k, letter in enumerate(order):
        mosaic[k // 2 :: 2, k % 2 :: 2] = colour[letter]
    image = decode(raw(f"bayer_{order}8", mosaic, 2))
    np.testing.assert_allclose(image, 0.299 * 200 + 0.587 * 90 + 0.114 * 20, atol=1.0)
    png = cv2.imencode(".png", mosaic)[1].tobytes()
    packed = file_payload(5, "run.bag /cam", png, f"bayer_{order}8; png compressed bayer_{order}8")
    np.testing.assert_array_equal(decode(packed), image)


@each(("encoding", "first"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_luma_of_yuv(encoding, first):
    pixels = RNG.integers(0, 256, (H, W, 2), dtype=np.uint8)
    np.testing.assert_array_equal(decode(raw(encoding, pixels)), pixels[:, :, first])


def test_step_of_zero_is_a_row_without_padding():
    np.testing.assert_array_equal(decode(dataclasses.replace(raw("mono8", GREY), step=0)), GREY)


@each("described", ["png", "bgr8; png compressed bgr8", "", "jpeg"])
def test_png_is_told_by_its_content(described):
    payload = file_payload(5, "x", cv2.imencode(".png", COLOUR[..., ::-1])[1].tobytes(), described)
    assert (payload.encoding, payload.width, payload.height) == ("png", W, H)
    np.testing.assert_allclose(decode(payload), LUMA, atol=1.0)


def test_jpeg():
    smooth = np.add.outer(np.arange(48), np.arange(64)).astype(np.uint8)
    payload = file_payload(5, "x", cv2.imencode(".jpg", smooth)[1].tobytes(), "bgr8; jpeg compressed bgr8")
    assert (payload.encoding, payload.width, payload.height) == ("jpeg", 64, 48)
    np.testing.assert_allclose(decode(payload).astype(float), smooth, atol=4)


def test_size_of_a_jpeg_behind_other_segments():
    """Cameras write EXIF, comments and fill bytes before the frame's header; EXIF's rotation is not applied."""
    data = cv2.imencode(".jpg", np.zeros((48, 64), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"  # orientation 6: a quarter turn
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + b"\xff\xfe\0\x04hi\xff"
    assert file_size(data[:2] + segment + data[2:]) == (64, 48)
    assert decode(file_payload(5, "x", data[:2] + segment + data[2:])).shape == (48, 64)


def test_png_of_sixteen_bits():
    # Of its own random numbers, and as many that percentiles are near: with few, other tests' draws decided.
    pixels = np.random.default_rng(16).integers(0, 4096, (10 * H, 10 * W)).astype(np.uint16)
    pixels[0, 0] = 4095
    payload = file_payload(5, "x", cv2.imencode(".png", pixels)[1].tobytes(), "mono16; png compressed mono16")
    np.testing.assert_allclose(decode(payload), pixels / 4095.0 * 255.0, atol=6.0)


@each("encoding", ["32FC1", "", "h264", "compresseddepth"])
def test_unknown_encoding(encoding):
    with pytest.raises(RecordingError, match=r"/cam: the image at 5 ns has the encoding '.*'.*one of .*mono8"):
        decode(raw(encoding, GREY))


@pytest.mark.parametrize(
    ("described", "encoding"), [("h264", "h264"), ("16UC1; compressedDepth", "16uc1 compresseddepth")]
)
def test_unknown_file(described, encoding):
    payload = file_payload(5, "run.bag /cam", b"\0\1\2\3", described)
    with pytest.raises(RecordingError, match=f"encoding '{encoding}'"):
        decode(payload)


@each("change", [{"height": H + 1}, {"width": W + 1}, {"step": W + 1}, {"height": 0}, {"data": b""}])
def test_too_few_bytes(change):
    with pytest.raises(DamagedImageError, match=r"/cam: the image at 5 ns has \d+ bytes, too few for .* px of mono8"):
        decode(dataclasses.replace(raw("mono8", GREY), **change))


@each("data", [b"\xff\xd8\xff\xe0 rubbish", b"\x89PNG\r\n\x1a\n", b"\x89PNG\r\n\x1a\n" + 40 * b"\0"])
def test_damaged_file(data):
    with pytest.raises(DamagedImageError, match="the image at 5 ns is damaged"):
        decode(file_payload(5, "x", data, "jpeg"))


def test_without_opencv_the_sentence_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "cv2", None)
    np.testing.assert_array_equal(decode(raw("mono8", GREY)), GREY)
    with pytest.raises(RecordingError, match=r"Images and tags need OpenCV, .*pip install .\.\[images\]"):
        decode(raw("bgr8", COLOUR))
