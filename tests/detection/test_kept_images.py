"""Images that are kept for the report while a stream is read: few, small and evenly spread."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from tests.typed import not_none

from icalib.data.images import Payload
from icalib.detection.images import MOST_BYTES, PICTURE_SIZE, SeenImages


def payload(k: int, image: np.ndarray) -> Payload:
    height, width = image.shape
    return Payload(10 * k, "camera", "mono8", image.tobytes(), width, height, width, name=f"{k}.png")


def decoded(jpeg: bytes) -> np.ndarray:
    return not_none(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE))


@pytest.mark.parametrize("stated", [0, 30, 1000])
def test_at_most_as_many_as_asked_evenly_spread(stated):
    """Recordings do not always tell how many images they have."""
    seen = SeenImages(stated, 10)
    for _ in range(2):  # for its hash, and for detection
        for k in range(1000):
            seen.add(payload(k, np.full((4, 6), k % 200, np.uint8)))
    at = np.array(list(seen.pictures)) // 10
    assert 5 <= len(at) <= 10
    assert len(set(np.diff(at))) == 1
    assert at[0] < 100
    assert at[-1] >= 850
    assert all(abs(int(decoded(seen.pictures[10 * k][1])[2, 3]) - k % 200) <= 2 for k in at)
    assert len(seen.files) == 1000


def test_none_are_kept_where_none_are_wanted():
    seen = SeenImages(3, 0)
    for k in range(3):
        seen.add(payload(k, np.zeros((4, 6), np.uint8)))
    assert not seen.pictures
    assert list(seen.files.values()) == ["0.png", "1.png", "2.png"]


def test_a_damaged_image_is_not_kept():
    seen = SeenImages(2, 2)
    seen.add(Payload(0, "camera", "png", b"\x89PNG\r\n\x1a\nnothing", 6, 4, name="0.png"))
    seen.add(payload(1, np.zeros((4, 6), np.uint8)))
    assert list(seen.pictures) == [10]
    assert list(seen.files) == [0, 10]


@pytest.mark.parametrize("shape", [(1200, 1600), (3000, 400)])
def test_even_noise_takes_no_more_than_the_bound(shape):
    seen = SeenImages(1, 1)
    seen.add(payload(0, np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)))
    name, jpeg = seen.pictures[0]
    image = decoded(jpeg)
    assert name == "0.png"
    assert len(jpeg) <= MOST_BYTES
    assert max(image.shape) <= PICTURE_SIZE
    assert image.shape[0] / image.shape[1] == pytest.approx(shape[0] / shape[1], rel=0.02)
