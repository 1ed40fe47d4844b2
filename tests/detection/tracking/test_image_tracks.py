"""From the images of a recording to feature tracks: kept for the next run, the same on any number of cores."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from tests.typed import StandIn

from icalib.data.recordings import Payload, TopicInfo
from icalib.detection import images as image_work
from icalib.errors import RecordingError
from icalib.rig import Camera
from icalib.sensors.camera.read import image_tracks
from icalib.sensors.camera.read.image_tracks import find_tracks

from .conftest import SIZE

CAMERA = Camera("cam0", "cam0/corners.csv", "pinhole-radtan", SIZE, tracks="images")
PERIOD_NS = 50_000_000


class Images(StandIn):
    """A recording of one camera; `damaged`: numbers of images that cannot be decoded."""

    def __init__(self, images: list[np.ndarray], damaged: tuple[int, ...] = (), period_ns: int = PERIOD_NS) -> None:
        self.images, self.damaged, self.period_ns = images, damaged, period_ns

    def image_topic(self, sensor: str, given: str | None) -> str:
        return "cam0"

    def where(self, sensor: object) -> str:
        return "rec/cam0"

    def topics(self) -> tuple[TopicInfo, ...]:
        return (TopicInfo("cam0", "images", "image", len(self.images), 0, len(self.images) * self.period_ns),)

    def payloads(self, topic: str) -> Iterator[Payload]:
        for k, image in enumerate(self.images):
            if k in self.damaged:
                yield Payload(k * self.period_ns, "rec/cam0", "png", b"nothing", 0, 0, name=f"{k}.png")
            else:
                yield Payload(
                    k * self.period_ns, "rec/cam0", "mono8", image.tobytes(), *image.shape[::-1], name=f"{k}.png"
                )


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("ICALIB_CACHE", str(tmp_path / "cache"))


def test_every_track_has_three_observations_and_segments_share_none(scene, monkeypatch):
    monkeypatch.setattr(image_tracks, "SEGMENT_IMAGES", 8)
    found, notes = find_tracks(Images(scene.images), CAMERA)
    assert notes == ()
    assert found.stamps_ns.tolist() == [k * PERIOD_NS for k in range(len(scene.images))]
    _, count = np.unique(found.feature, return_counts=True)
    assert count.min() >= 3
    first, second = (set(found.feature[found.image // 8 == k].tolist()) for k in (0, 1))
    assert first and second and not first & second


def test_tracks_do_not_depend_on_the_number_of_cores(scene, monkeypatch):
    monkeypatch.setattr(image_tracks, "SEGMENT_IMAGES", 8)
    found = []
    for cores in (1, 3):
        monkeypatch.setattr(image_work, "core_count", lambda cores=cores: cores)
        found.append(find_tracks(Images(scene.images), CAMERA, keep=False)[0])
    np.testing.assert_array_equal(found[0].feature, found[1].feature)
    np.testing.assert_array_equal(found[0].uv, found[1].uv)


def test_what_was_found_is_kept_until_the_images_change(scene, monkeypatch):
    first, _ = find_tracks(Images(scene.images), CAMERA)
    monkeypatch.setattr(image_tracks, "Tracker", None)
    again, _ = find_tracks(Images(scene.images), CAMERA)
    np.testing.assert_array_equal(first.uv, again.uv)
    np.testing.assert_array_equal(first.views, again.views)
    np.testing.assert_array_equal(first.spread, again.spread)
    with pytest.raises(TypeError):
        find_tracks(Images(scene.images[1:]), CAMERA)


def test_images_at_a_high_rate_are_tracked_and_thinned(scene):
    """At 60 Hz every third counts as a view, so that tracks last long enough for the motion to show."""
    found, notes = find_tracks(Images(scene.images, period_ns=16_666_667), CAMERA)
    assert notes == () and len(found.stamps_ns) == 7
    assert np.diff(found.stamps_ns).tolist() == [50_000_001] * 6


def test_images_too_large_to_wait_give_the_same_tracks(scene, monkeypatch):
    small, _ = find_tracks(Images(scene.images), CAMERA, keep=False)
    monkeypatch.setattr(image_tracks, "SEGMENT_BYTES", 1000)
    large, _ = find_tracks(Images(scene.images), CAMERA, keep=False)
    np.testing.assert_array_equal(small.uv, large.uv)
    np.testing.assert_array_equal(small.feature, large.feature)


def test_a_damaged_image_is_left_out_with_a_note(scene):
    found, notes = find_tracks(Images(scene.images, damaged=(4,)), CAMERA)
    assert len(found.stamps_ns) == len(scene.images) - 1
    assert notes == ("rec/cam0: 1 damaged images were ignored, the first 4.png.",)


def test_a_part_of_the_robot_in_view_is_left_out_with_a_note(scene):
    part = np.random.default_rng(1).integers(30, 220, (15, 50)).astype(np.uint8).repeat(4, axis=0).repeat(4, axis=1)
    images = [image.copy() for image in scene.images]
    for image in images:
        image[170:230, 60:260] = part
    found, notes = find_tracks(Images(images), CAMERA)
    x, y = found.uv.T
    assert not ((x > 65) & (x < 255) & (y > 175) & (y < 225)).any()
    assert "points keep their place in the image while the camera turns" in notes[-1]


def test_images_without_texture_are_refused():
    grey = [np.full(SIZE[::-1], 90, np.uint8)] * 5
    with pytest.raises(RecordingError, match="only 0 of 5 images have 12 tracked points or more"):
        find_tracks(Images(grey), CAMERA)


def test_images_of_another_size_are_refused(scene):
    other = Camera("cam0", "", "pinhole-radtan", (640, 480))
    with pytest.raises(RecordingError, match="320 x 240 px, but cam0 640 x 480"):
        find_tracks(Images(scene.images), other)


def test_no_images_that_can_be_decoded_are_refused(scene):
    with pytest.raises(RecordingError, match="is damaged"):
        find_tracks(Images(scene.images[:3], damaged=(0, 1, 2)), CAMERA)
