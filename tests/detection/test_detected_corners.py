"""From the images of a recording to its corners: every image once, in order, kept for the next run."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.typed import StandIn

from icalib.data.recordings import Payload, TopicInfo
from icalib.detection import images as image_work
from icalib.detection.decoding import ImageCorners, no_corners
from icalib.errors import RecordingError
from icalib.geometry.targets import AprilGrid, Markers, Scene
from icalib.rig import Camera
from icalib.sensors.camera.read import detected_corners

GRID = AprilGrid(6, 6, 0.088, 0.3)
CAMERA = Camera("cam0", "cam0/corners.csv", "pinhole-radtan", (8, 6))


class FakeRecording(StandIn):
    """Images of 6 x 8 px; the first pixel counts them."""

    def __init__(self, n: int = 20, width: int = 8, size: int = 48, damaged: tuple[int, ...] = ()) -> None:
        self.n, self.width, self.size, self.damaged = n, width, size, damaged
        self.files = False
        self.read = 0

    def image_topic(self, sensor: str, given: str | None) -> str:
        return "/cam0"

    def where(self, sensor: object) -> str:
        return "fake.bag /cam0"

    def topics(self) -> tuple[TopicInfo, ...]:
        return (TopicInfo("/cam0", "sensor_msgs/msg/Image", "image", self.n, 0, self.n),)

    def payloads(self, topic: str) -> Iterator[Payload]:
        for i in range(self.n):
            self.read += 1
            data = bytes([i]) + bytes([100]) * (self.size - 1)
            if i not in self.damaged:
                yield Payload(1000 + i, "fake.bag /cam0", "mono8", data, self.width, 6, self.width, name=self.named(i))
            else:
                yield Payload(1000 + i, "fake.bag /cam0", "png", data, 0, 0, name=self.named(i))

    def named(self, i: int) -> str:
        return f"left{i}.png" if self.files else ""


class FakeDetector:
    """One corner at (first pixel, 1); counts what it was shown, and by which threads."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        self.fail_at = -1

    def detect(self, image: np.ndarray, before=()) -> ImageCorners:
        i = int(image[0, 0])
        if i == self.fail_at:
            raise KeyboardInterrupt
        self.seen.append(i)
        if i % 5 == 4:
            return no_corners()
        one = np.ones(1)
        return ImageCorners(np.array([i % 3]), np.array([[float(i), 1.0]]), 0.1 * one, one, np.zeros(1, np.int8))


@pytest.fixture
def detector(monkeypatch, tmp_path) -> FakeDetector:
    fake = FakeDetector()
    monkeypatch.setattr(detected_corners, "detector_of", lambda target: fake)
    monkeypatch.setenv("ICALIB_CACHE", str(tmp_path / "cache"))
    return fake


@pytest.mark.parametrize("together", [1, 6, 10, 256])
def test_every_image_is_searched_once_and_stands_in_order(detector, monkeypatch, together):
    monkeypatch.setattr(detected_corners, "PACKED", together)
    done = []
    found, notes = detected_corners.find_corners(FakeRecording(), CAMERA, GRID, True, done.append)
    assert sorted(detector.seen) == list(range(20))
    np.testing.assert_array_equal(found.stamps_ns, 1000 + np.arange(20))
    seen = [i for i in range(20) if i % 5 != 4]
    np.testing.assert_array_equal(found.uv[:, 0], seen)
    np.testing.assert_array_equal(found.point, [i % 3 for i in seen])
    assert done == sorted(done) and done[-1] == 1.0
    assert notes == ("fake.bag /cam0: the target is in 16 of 20 images, 16 corners.",)


@pytest.mark.parametrize("found", [100, 40])
def test_another_layout_is_looked_for_where_little_of_a_grid_is_found(detector, monkeypatch, found):
    point, one = np.arange(found), np.ones(found)
    whole = ImageCorners(point, np.zeros((found, 2)), 0.1 * one, one, np.zeros(found, np.int8))
    monkeypatch.setattr(detector, "detect", lambda image, before=(): whole)
    asked = []
    monkeypatch.setattr(detected_corners, "other_columns", lambda images, part: asked.append(part) or "")
    monkeypatch.setattr(detected_corners, "with_other_border", lambda images, tags, others: "")
    detected_corners.find_corners(FakeRecording(), CAMERA, GRID)
    assert asked == ([GRID] if found < 0.5 * len(GRID.points) else [])


def test_many_single_tags_are_looked_for_once(detector, monkeypatch):
    """Each tag is in few images, which is no reason to look for another border. Those in none are, in one pass."""
    tags = Scene(tuple(f"tag{k}" for k in range(9)), tuple(Markers("tag36h11", 0.1, (k,)) for k in range(9)))
    one = np.ones(4)
    monkeypatch.setattr(
        detector,
        "detect",
        lambda image, before=(): ImageCorners(
            4 * (int(image[0, 0]) % 7) + np.arange(4), np.zeros((4, 2)), 0.1 * one, one, np.zeros(4, np.int8)
        ),
    )
    asked = []
    monkeypatch.setattr(detected_corners, "with_other_border", lambda views, tags, others: asked.append(tags.ids) or "")
    recording = FakeRecording()
    _, notes = detected_corners.find_corners(recording, CAMERA, tags)
    assert asked == [(7,), (8,)] and recording.read <= 3 * recording.n
    assert "tag0 is in 3, tag1 is in 3" in notes[0] and notes[1].startswith("fake.bag /cam0: tag7 and tag8 is never")
    asked.clear()
    detected_corners.find_corners(recording, CAMERA, Scene(tags.names[:7], tags.targets[:7]))
    assert asked == [] and recording.read <= 5 * recording.n


def test_a_second_run_looks_at_nothing(detector):
    first = detected_corners.find_corners(FakeRecording(), CAMERA, GRID)
    detector.seen.clear()
    second = detected_corners.find_corners(FakeRecording(), CAMERA, GRID)
    assert detector.seen == []
    for a, b in zip(vars(first[0]).values(), vars(second[0]).values(), strict=True):
        np.testing.assert_array_equal(a, b)
    assert first[1] == second[1]


@pytest.mark.parametrize("other", [FakeRecording(19), FakeRecording(21)])
def test_other_images_are_searched(detector, other):
    detected_corners.find_corners(FakeRecording(), CAMERA, GRID)
    detector.seen.clear()
    detected_corners.find_corners(other, CAMERA, GRID)
    assert len(detector.seen) == other.n


def test_another_target_is_searched_for(detector):
    detected_corners.find_corners(FakeRecording(), CAMERA, GRID)
    detector.seen.clear()
    detected_corners.find_corners(FakeRecording(), CAMERA, AprilGrid(6, 6, 0.088, 0.25))
    assert len(detector.seen) == 20


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 truncated", b"no zip at all" * 50])
def test_a_damaged_file_in_the_cache_is_no_file(detector, tmp_path, content):
    detected_corners.find_corners(FakeRecording(), CAMERA, GRID)
    (kept,) = (tmp_path / "cache").iterdir()
    kept.write_bytes(content)
    detector.seen.clear()
    found, _ = detected_corners.find_corners(FakeRecording(), CAMERA, GRID)
    assert len(detector.seen) == 20 and len(found.uv) == 16


def test_nothing_is_kept_where_that_is_switched_off_or_cannot_be(detector, tmp_path, monkeypatch):
    detected_corners.find_corners(FakeRecording(), CAMERA, GRID, keep=False)
    assert not (tmp_path / "cache").exists()
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("ICALIB_CACHE", str(tmp_path / "file"))
    found, _ = detected_corners.find_corners(FakeRecording(), CAMERA, GRID)
    assert len(found.uv) == 16


def test_few_images_wait_in_memory(detector, monkeypatch):
    """The reader never runs ahead of the detectors by more than the bound: turns that wait, one that is made, and those
    that are searched."""
    monkeypatch.setattr(image_work, "core_count", lambda: 2)
    monkeypatch.setattr(detected_corners, "IN_TURN", 4)
    recording, ahead = FakeRecording(60), []
    plain = detector.detect
    gate = threading.Semaphore(0)

    def slow(image: np.ndarray, before=()) -> ImageCorners:
        ahead.append(recording.read - len(detector.seen))
        gate.acquire(timeout=0.01)
        return plain(image, before)

    monkeypatch.setattr(detector, "detect", slow)
    detected_corners.find_corners(recording, CAMERA, GRID, keep=False)
    assert max(ahead) <= (2 + 2) * 4


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize(("most", "images"), [(1 << 20, 6), (3 * 48, 3), (1, 1)])
def test_what_leads_the_search_does_not_depend_on_the_number_of_threads(detector, monkeypatch, workers, most, images):
    """Each image is searched after those of its turn, in order: 6 images, or as many as have `most` bytes."""
    monkeypatch.setattr(image_work, "core_count", lambda: workers)
    monkeypatch.setattr(detected_corners, "IN_TURN", 6)
    monkeypatch.setattr(detected_corners, "BYTES_IN_TURN", most)
    led, plain = {}, detector.detect

    def noted(image: np.ndarray, before=()) -> ImageCorners:
        led[int(image[0, 0])] = [one.uv[:, 0].tolist() for one in before]
        return plain(image, before)

    monkeypatch.setattr(detector, "detect", noted)
    detected_corners.find_corners(FakeRecording(), CAMERA, GRID, keep=False)
    seen = [[float(i)] if i % 5 != 4 else [] for i in range(20)]
    assert led == {i: seen[max(i - 3, i - i % images) : i] for i in range(20)}


def test_an_interrupted_search_keeps_nothing(detector, tmp_path):
    detector.fail_at = 11
    with pytest.raises(KeyboardInterrupt):
        detected_corners.find_corners(FakeRecording(), CAMERA, GRID)
    assert not list(Path(tmp_path).rglob("*.npz"))


def test_images_of_another_size_are_refused(detector):
    with pytest.raises(RecordingError, match="images have 6 x 6 px, but cam0 8 x 6; correct its resolution"):
        detected_corners.find_corners(FakeRecording(width=6), CAMERA, GRID)


@pytest.mark.parametrize("files", [False, True])
def test_damaged_images_are_named(detector, files):
    """Also where their corners were found by an earlier run."""
    recording = FakeRecording(damaged=(7, 11))
    recording.files = files
    for _ in range(2):
        found, notes = detected_corners.find_corners(recording, CAMERA, GRID)
        assert len(found.stamps_ns) == 18
        which = "left7.png" if files else "at 1007 ns"
        assert notes[-1] == f"fake.bag /cam0: 2 damaged images were ignored, the first {which}."
        assert found.which(1003) == ("left3.png" if files else "at 1003 ns")


def test_damaged_images_are_left_out_and_all_damaged_are_refused(detector):
    with pytest.raises(RecordingError, match="fake.bag /cam0"):
        detected_corners.find_corners(FakeRecording(size=20), CAMERA, GRID)
